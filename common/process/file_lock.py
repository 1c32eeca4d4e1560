"""A lock on a file that one process holds at a time, and that goes with it."""

import fcntl
import logging
import os
import time
from pathlib import Path

LOCK_SECONDS = 5.0  # that a lock is waited for: who held it may be about to end
LOOK_SECONDS = 0.1
log = logging.getLogger(__name__)


def take_lock(path: Path, patience: float = LOCK_SECONDS) -> int | None:
    """A handle that holds the lock until it is closed; None where another process keeps it."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)  # whoever may enter the folder may look
    began = time.monotonic()
    warned = False
    while not try_lock(handle, fcntl.LOCK_EX):
        if time.monotonic() >= began + patience:
            os.close(handle)
            return None
        if not warned:
            log.warning("waiting up to %g s for another process to let go of %s", patience, path)
            warned = True
        time.sleep(LOOK_SECONDS)
    return handle


def try_lock(handle: int, kind: int) -> bool:
    """Whether the handle has the lock now, ``fcntl.LOCK_EX`` or ``fcntl.LOCK_SH``."""
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
