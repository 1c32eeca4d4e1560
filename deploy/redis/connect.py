"""How a role reaches the run's Redis, and how long it waits for it."""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.bus.redis_url import redacted
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.role import RECONNECT_SLEEP, StopSignal
from rmc.common.user_path import user_path

log = logging.getLogger(__name__)
T = TypeVar("T")
PATIENCE_VARIABLE = "RMC_PATIENCE"  # seconds that a role which starts while Redis is coming back waits for it
AWAY_SECONDS = 30.0  # of a Redis that has just answered, until what begins gives up
PATIENCE_SECONDS = "30"  # of one that is started by hand, at the same time as its run perhaps


class Deadline:
    """So many seconds for something that is about to come, less where a stop is asked for.

    The log says once what is waited for.
    """

    def __init__(self, seconds: float, stop: StopSignal) -> None:
        self._seconds, self._deadline = seconds, time.monotonic() + seconds
        self._stop = stop
        self._warned = False

    def wait(self, awaited: str) -> bool:
        """Wait a moment; False once there is none left."""
        if self._stop.requested or time.monotonic() >= self._deadline:
            return False
        if not self._warned:
            log.warning("waiting up to %g s for %s", self._seconds, awaited)
            self._warned = True
        time.sleep(RECONNECT_SLEEP)
        return True


def connect(url: str, run: str, waits: Deadline | None = None) -> RedisBus:
    """A bus whose Redis answers, at once or within that patience; ``file:PATH`` holds the URL. Raises ConfigError."""
    if url.startswith("file:"):
        url = _in_file(user_path(url.removeprefix("file:")))
    bus = RedisBus(url, run)
    while True:
        try:
            with suppress(BusFull):  # that is an answer
                bus.ping()
            return bus
        except BusUnavailable as error:
            if waits is None or not waits.wait(f"the Redis at {redacted(url)}: {error}"):
                raise ConfigError("--redis-url", redacted(url), f"no Redis answers there ({error})") from None


def tried_again(call: Callable[[], T], stop: StopSignal) -> T:
    """Make a call of a Redis that has just answered, again where it is away for a moment.

    Raises BusUnavailable; KeyboardInterrupt where that is waited for and the run is stopped.
    """
    waits = Deadline(AWAY_SECONDS, stop)
    while True:
        try:
            return call()
        except BusUnavailable as error:
            if waits.wait(f"Redis: {error}"):
                continue
            if stop.requested:
                raise KeyboardInterrupt from None
            raise


def _in_file(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError as error:
        raise ConfigError("--redis-url", f"file:{path}", f"cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError("--redis-url", f"file:{path}", "is no text; write the URL into it, in one line") from None
