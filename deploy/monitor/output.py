"""Standard output and standard error that never fail: what they do not take goes to a run's own log."""

import errno
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, TextIO

from rmc.common.whole_file import NO_ROOM

PLAIN = str.maketrans({"±": "+-", "·": "-", "→": "->", "…": "...", "–": "-"})  # for a terminal that has ASCII alone
PASSING = {*NO_ROOM, errno.EAGAIN}  # there may be room again


class Output:
    """A text stream in place of ``sys.stdout`` or ``sys.stderr``."""

    log: ClassVar[Path | None] = None  # of the run that this process trains

    def __init__(self, stream: TextIO | None) -> None:
        """``stream`` is None where it was closed before this process began."""
        self._stream: TextIO = stream or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - as long as this one
        self.failure = "" if stream is not None else os.strerror(errno.EBADF)  # why something was not written
        self.lost = stream is None  # for good

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            if not self.lost:
                self._stream.write(self._fitting(text))
                self._stream.flush()
                return len(text)
        except (OSError, ValueError) as error:  # ValueError: closed since
            self.lost = not isinstance(error, OSError) or error.errno not in PASSING
            self.failure = getattr(error, "strerror", None) or str(error)
        self.keep(text)
        return len(text)

    def flush(self) -> None:
        """All is written at once."""

    def _fitting(self, text: str) -> str:
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        try:
            text.encode(encoding)
        except UnicodeEncodeError:
            return text.translate(PLAIN).encode(encoding, "replace").decode(encoding)
        return text

    @classmethod
    def keep(cls, text: str) -> None:
        """Write into the run's log, where there is one."""
        if cls.log is not None:
            with suppress(OSError), cls.log.open("a", encoding="utf-8", errors="replace") as log:
                log.write(text)


def unfailing(stream: TextIO | None) -> Any:
    """The stream as one that never fails."""
    return stream if isinstance(stream, Output) else Output(stream)


def take_over() -> None:
    """From now on this process's own streams never fail, and no file takes the number of one that was closed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    sys.stdout, sys.stderr = unfailing(sys.stdout), unfailing(sys.stderr)
