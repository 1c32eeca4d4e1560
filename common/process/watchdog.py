"""Ends a process that hangs, even in a library's C code."""

import faulthandler
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Watchdog:
    """Where no ``beat`` came for ``seconds`` (up to a tenth more), the process dies with its traceback on stderr."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._next = seconds, float("-inf")

    def beat(self) -> None:
        """All is well. Costs a look at the clock, and a new timer ten times in ``seconds``."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + self._seconds / 10
            faulthandler.dump_traceback_later(1.1 * self._seconds, exit=True)

    @contextmanager
    def asleep(self) -> Iterator[None]:
        """Watch nothing in here; afterwards it begins anew, if it had begun."""
        begun = self._next > float("-inf")
        faulthandler.cancel_dump_traceback_later()
        try:
            yield
        finally:
            self._next = float("-inf")
            if begun:
                self.beat()

    def close(self) -> None:
        """Watch no more."""
        faulthandler.cancel_dump_traceback_later()
