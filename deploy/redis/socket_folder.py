"""The temporary folder of a run's sockets: private, short, locked while its launcher lives."""

import fcntl
import logging
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

from rmc.common.errors import ConfigError, RoleDied
from rmc.common.process.file_lock import try_lock
from rmc.deploy.redis.server import SOCKET_PATH_LIMIT

PREFIX = "rmc-sockets-"
LONGEST_NAME = "replay-9999.sock"
USUAL = (Path("/tmp"), Path("/var/tmp"))  # where TMPDIR is too long
log = logging.getLogger(__name__)


class SocketFolder:
    """Made at once, gone at ``close``. Its lock tells other launchers that it is in use, whoever's process numbers
    they see.

    Raises ConfigError where there is no place for it.
    """

    def __init__(self) -> None:
        place = place_for_sockets()
        remove_stale(place)
        while True:  # until it is locked before another launcher has swept it
            self.path = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-", dir=place))  # its owner's alone
            try:
                self._lock = _locked(self.path)
            except OSError:  # a disk without locks: nobody takes one away from it either
                self._lock = None
                return
            if self._lock is not None:
                return

    def renew(self) -> None:
        """Make it again where others, like a cleaner of old files, have removed it.

        Raises RoleDied where it cannot be made again.
        """
        if self.path.is_dir() and (self._lock is None or os.path.samestat(os.fstat(self._lock), self.path.stat())):
            return
        try:
            self.path.mkdir(0o700)
        except OSError as error:
            raise RoleDied(f"{self.path} was removed, and cannot be made again ({error.strerror})") from None
        lock = None
        with suppress(OSError):  # as when it was made first
            lock = _locked(self.path)
        if self._lock is not None:
            os.close(self._lock)
        self._lock = lock
        log.warning("%s was removed; it is made again", self.path)

    def close(self) -> None:
        """Remove it. One that others have removed is no fault."""
        shutil.rmtree(self.path, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def place_for_sockets() -> Path:
    """Where temporary folders are made whose sockets have a path that fits. Raises ConfigError."""
    try:
        usual = Path(tempfile.gettempdir())
    except FileNotFoundError:
        tried = os.environ.get("TMPDIR") or "/tmp"
        raise ConfigError("TMPDIR", tried, "no temporary folder can be written; set it to one that can") from None
    for place in (usual, *USUAL):
        if _fits(place) and os.access(place, os.W_OK | os.X_OK):
            return place
    fix = f"the path of a socket there has more than {SOCKET_PATH_LIMIT} bytes; set it to a shorter one"
    raise ConfigError("TMPDIR", str(usual), fix)


def _fits(place: Path) -> bool:
    try:
        return len(str(place / f"{PREFIX}{2**22}-12345678" / LONGEST_NAME).encode()) <= SOCKET_PATH_LIMIT
    except UnicodeEncodeError:  # no URL can hold it
        return False


def remove_stale(place: Path) -> None:
    """Remove what launchers killed by force have left; their processes died with them."""
    for leftover in place.glob(f"{PREFIX}*"):
        with suppress(OSError):  # another launcher sweeps, too; or it is somebody else's
            if leftover.lstat().st_uid == os.getuid() and (lock := _locked(leftover)) is not None:
                shutil.rmtree(leftover, ignore_errors=True)
                os.close(lock)


def _locked(folder: Path) -> int | None:
    """A handle that holds the folder's lock; None where another process has it, or the folder is gone."""
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    with suppress(FileNotFoundError):
        if try_lock(handle, fcntl.LOCK_EX) and os.path.samestat(os.fstat(handle), folder.lstat()):
            return handle
    os.close(handle)
    return None
