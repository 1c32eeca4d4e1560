"""An outage of Redis as the log tells it: once when it begins, once when it is over."""

import logging
import time

log = logging.getLogger(__name__)


class OutageLog:
    """Of one process, named ``role`` in the log."""

    def __init__(self, role: str) -> None:
        self._role = role
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        """For how long it has lasted; 0 where there is none."""
        return 0.0 if self._since is None else time.monotonic() - self._since

    def begin(self, error: Exception) -> None:
        """Redis was away or full just now."""
        if self._since is None:
            self._since = time.monotonic()
            log.warning("%s: waiting for Redis: %s", self._role, error)

    def end(self) -> None:
        """It has answered."""
        if self._since is not None:
            log.warning("%s: Redis is back after %.1f s", self._role, time.monotonic() - self._since)
            self._since = None
