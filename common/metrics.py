"""Small means of measuring: running means, rates, and who is busy or waits for what."""

import time
from collections import defaultdict, deque
from typing import Any

RATE_SECONDS = 10.0


class Means:
    """Means of named numbers since the last ``take``."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = defaultdict(float)
        self._counts: dict[str, int] = defaultdict(int)

    def add(self, name: str, value: float) -> None:
        self._sums[name] += value
        self._counts[name] += 1

    def take(self) -> dict[str, float]:
        """The means, and forget them."""
        means = {name: self._sums[name] / self._counts[name] for name in self._sums}
        self._sums.clear()
        self._counts.clear()
        return means


class Rate:
    """How fast a counter moves, per second, over the last ten or so: actors step in bursts, as credit comes."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()

    def take(self, counter: float) -> float:
        """The rate up to now; 0 at the first call."""
        now = time.monotonic()
        while len(self._samples) > 1 and self._samples[1][0] <= now - RATE_SECONDS:
            self._samples.popleft()
        self._samples.append((now, counter))
        since, before = self._samples[0]
        return (counter - before) / (now - since) if now > since else 0.0


class BusyClock:
    """Splits wall time into busy and waiting, with what is waited for and since when."""

    def __init__(self) -> None:
        self._mark = self._since = time.monotonic()
        self._busy = self._waiting = 0.0
        self._reason = ""

    def _lap(self) -> float:
        now = time.monotonic()
        lap, self._mark = now - self._mark, now
        return lap

    def busy(self) -> None:
        """The time since the last call was work."""
        self._busy += self._lap()
        self._reason = ""

    def wait(self, reason: str) -> None:
        """The time since the last call was spent waiting for ``reason``."""
        if self._reason != reason:
            self._since, self._reason = self._mark, reason
        self._waiting += self._lap()

    def shares(self) -> dict[str, Any]:
        """``busy_share``, ``waiting_share`` (0 to 1), ``waiting_for``, ``waiting_s``; then start anew."""
        total = self._busy + self._waiting
        record: dict[str, Any] = {
            "busy_share": self._busy / total if total else 0.0,
            "waiting_share": self._waiting / total if total else 0.0,
            "waiting_for": self._reason,
            "waiting_s": time.monotonic() - self._since if self._reason else 0.0,
        }
        self._busy = self._waiting = 0.0
        return record
