"""A lock on a file that one process holds at a time, and that goes with it."""

import errno
import fcntl
import logging
import os
import time
from contextlib import suppress
from pathlib import Path

from rmc.common.errors import ConfigError

LOCK_SECONDS = 5.0  # that a lock is waited for: who held it may be about to end
LOOK_SECONDS = 0.1
WITHOUT_LOCKS = {errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK}  # of a disk that has none
log = logging.getLogger(__name__)


def take_lock(path: Path, patience: float = LOCK_SECONDS) -> int | None:
    """A handle that holds the lock until it is closed; None where another process keeps it. Raises ConfigError."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)  # whoever may enter the folder may look
    began = time.monotonic()
    warned = False
    while not _locked(handle, path):
        if time.monotonic() >= began + patience:
            os.close(handle)
            return None
        if not warned:
            log.warning("waiting up to %g s for another process to let go of %s", patience, path)
            warned = True
        time.sleep(LOOK_SECONDS)
    return handle


def release_lock(handle: int) -> None:
    """Let another process have it, also where one that was forked from this one keeps the file open."""
    with suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def _locked(handle: int, path: Path) -> bool:
    """Whether it is, now. Raises ConfigError where the disk has no locks, and closes it."""
    try:
        return try_lock(handle, fcntl.LOCK_EX)
    except OSError as error:
        os.close(handle)
        fix = f"its disk locks no files ({error.strerror}); take a folder on another"
        raise ConfigError("lock", str(path), fix) from None


def try_lock(handle: int, kind: int) -> bool:
    """Whether the handle has the lock now, ``fcntl.LOCK_EX`` or ``fcntl.LOCK_SH``. Raises OSError."""
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
