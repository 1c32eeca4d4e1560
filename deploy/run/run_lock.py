"""The lock of a run's folder: which launcher trains the run, where, and how the last one ended.

``.lock`` holds ``training PID MACHINE CONTAINER BOOT`` while a launcher trains the run, then ``ended STATUS``. Where a
sweep's run is on some node of Ray, it holds ``training PID Ray``, with the sweep's process.
"""

import errno
import fcntl
import os
import re
import socket
from contextlib import suppress
from pathlib import Path

import psutil

from rmc.common.errors import ConfigError
from rmc.common.process.file_lock import WITHOUT_LOCKS, release_lock, take_lock, try_lock

BOOT = Path("/proc/sys/kernel/random/boot_id")  # no two machines have one
PROCESS = re.compile("[1-9][0-9]{0,8}")  # a signal to 0 or -1 would reach many
ON_RAY = "Ray"
LOCK_SECONDS = 1.0  # others look, now and then, whether the folder is locked


class RunLock:
    """One launcher has it at a time, and it goes with the launcher's process."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / ".lock"
        self._handle: int | None = None
        self._locked_folder: os.stat_result | None = None
        self._before = ""  # what the last launcher has left in it

    def take(self, elsewhere: str = "") -> None:
        """Be the one launcher of this run; ``elsewhere`` is where it trains, if not in this process's place.

        Raises ConfigError where another one is, or the folder cannot be written.
        """
        self.check_untrained()
        try:
            self._handle = take_lock(self._file, LOCK_SECONDS)
        except OSError as error:
            if error.errno not in (errno.EROFS, errno.EACCES):
                raise
            fix = f"cannot be written ({error.strerror}); copy the run elsewhere, or make it writable"
            raise ConfigError("RUN", str(self._folder), fix) from None
        if self._handle is None:
            raise self._is_trained()
        self._locked_folder, self._before = self._folder.stat(), self._file.read_text(errors="replace")
        try:
            self._note(" ".join(["training", str(os.getpid()), *([elsewhere] if elsewhere else _process_space())]))
        except BaseException:  # a full disk; a notebook would keep the lock
            self.give_back()
            raise

    def release(self, status: int | None = None) -> None:
        """Let another launcher in; ``status`` is how this one ended, if it trained."""
        self._leave("" if status is None else f"ended {status}")

    def give_back(self) -> None:
        """Let another launcher in, and leave what the last one has said: this one was refused."""
        self._leave(self._before)

    def _leave(self, text: str) -> None:
        if self._handle is not None:
            with suppress(OSError):  # no room
                self._note(text)
            release_lock(self._handle)
            self._handle = None

    def _note(self, text: str) -> None:
        """Over what is there: on a full disk that needs no new block."""
        assert self._handle is not None
        content = text.encode()
        os.pwrite(self._handle, content.ljust(os.fstat(self._handle).st_size), 0)
        os.ftruncate(self._handle, len(content))

    def check_there(self) -> None:
        """Raises ConfigError where it is not the folder any more that was locked, or has lost what it goes on from."""
        needed = (self._folder, self._folder / "config.json", self._folder / "secret")
        try:
            here, *_ = [path.stat() for path in needed]
            if self._locked_folder is None or os.path.samestat(self._locked_folder, here):
                return
        except (FileNotFoundError, NotADirectoryError):
            pass
        except OSError:  # a network's disk that is away for a moment
            return
        fix = "was deleted or moved while it was trained; if it was moved, give its new place to go on"
        raise ConfigError("--run-dir", str(self._folder), fix)

    def check_untrained(self) -> None:
        """Raises ConfigError where a launcher trains the run."""
        if self.trainer() is not None:
            raise self._is_trained()

    def _is_trained(self) -> ConfigError:
        fix = "this run is being trained; stop it first, or look at it: rmc stats"
        return ConfigError("--run-dir", str(self._folder), fix)

    def trainer(self) -> int | None:
        """The process of the launcher that trains this run now, if one does, wherever that is."""
        try:
            with self._file.open("rb") as file:
                word, *rest = file.read().decode().split()
                free = try_lock(file.fileno(), fcntl.LOCK_SH)
                return None if free or word != "training" or not PROCESS.fullmatch(rest[0]) else int(rest[0])
        except (FileNotFoundError, ValueError, IndexError):
            return None
        except OSError as error:
            if error.errno not in WITHOUT_LOCKS:
                raise
            return None  # a copy: no launcher trains where it cannot lock

    def is_held_by(self, process: int) -> bool:
        """Whether that process has the lock's file open; False where others hide theirs."""
        with suppress(psutil.Error, OSError):  # it has ended, or the run's folder has gone
            opened = [file.path for file in psutil.Process(process).open_files()]
            return any(Path(path).name == self._file.name and self._file.samefile(path) for path in opened)
        return False

    def trained_elsewhere(self) -> str:
        """The machine or container whose launcher trains this run; empty where that is here, or none does."""
        here, space = _process_space(), self._file.read_text().split()[2:]
        first = 1 if len(space) == 3 else 0  # a machine may be renamed; versions before noted less
        if space[first:] == here[first : len(space)]:
            return ""
        return f"another machine or container called {space[0]}" if space[0] == here[0] else space[0]

    def is_on_ray(self) -> bool:
        """Whether a sweep trains it on some node of Ray, as far as this user may know."""
        with suppress(OSError):
            return self.trainer() is not None and self.trained_elsewhere() == ON_RAY
        return False

    def ended(self) -> int | None:
        """The exit status of the launcher that trained it last, if that came to an end of its own.

        Raises ConfigError where that is damaged.
        """
        try:
            word, _, number = self._file.read_text().partition(" ")
            return int(number) if word == "ended" else None
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise ConfigError("RUN", str(self._folder), f".lock is damaged ({error}); remove that file") from None

    def lost(self) -> bool:
        """Whether the launcher that trained it last is gone without a word."""
        return self._file.exists() and self._file.read_text().startswith("training") and self.trainer() is None


def _process_space() -> list[str]:
    """Where this process has its number: the machine, the container on it, and the boot, as names may be shared."""
    space = [socket.gethostname()]
    with suppress(OSError):  # not on Linux
        space.append(os.readlink("/proc/self/ns/pid"))
        space.append(BOOT.read_text().strip())
    return space
