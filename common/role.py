"""A role and the loop that every role shares: stop signal, heartbeat metrics, waiting out Redis."""

import logging
import signal
import time
from collections.abc import Callable
from typing import Any, Protocol

from common.bus import Bus
from common.errors import BusFull, BusUnavailable
from common.metrics import BusyClock

log = logging.getLogger(__name__)
METRICS_PERIOD = 1.0  # seconds between a role's metrics records, which are its heartbeat too
STOP_PERIOD = 0.5  # seconds between looks at the bus's stop key
IDLE_SLEEP = 0.002  # seconds slept when a step had nothing to do
RECONNECT_SLEEP = 0.5  # seconds between tries while Redis is away or full


class Role(Protocol):
    """A process of a run. ``name`` is unique in it, like ``actor-0``."""

    name: str

    def step(self) -> bool:
        """One bounded piece of work; False where there was none and the loop should sleep briefly."""

    def waiting_for(self) -> str:
        """What the role waits for when ``step`` found nothing to do, like ``credit``."""

    def metrics(self) -> dict[str, Any]:
        """Flat metrics since the last call."""

    def close(self) -> None:
        """End in order: save what must be saved, leave nothing behind."""


class StopSignal:
    """Set by SIGTERM and SIGINT; the loop looks at it between steps."""

    def __init__(self) -> None:
        self.requested = False

    def install(self) -> None:
        """Catch both signals in this process."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self.request())

    def request(self) -> None:
        self.requested = True


def run_role(role: Role, bus: Bus, stop: StopSignal, finished: Callable[[], bool] = lambda: False) -> None:
    """Step a role until it is stopped, fenced or finished; always closes it.

    Redis away or full is waited out here; every other error ends the role.
    """
    clock = BusyClock()
    next_metrics = next_stop = 0.0
    try:
        while not stop.requested and not finished():
            try:
                now = time.monotonic()
                if now >= next_stop:
                    next_stop = now + STOP_PERIOD
                    if bus.stop_requested() is not None:
                        return
                if now >= next_metrics:
                    next_metrics = now + METRICS_PERIOD
                    bus.emit(role.name, {"time": time.time(), **role.metrics(), **clock.shares()})
                if role.step():
                    clock.busy()
                else:
                    clock.wait(role.waiting_for())
                    time.sleep(IDLE_SLEEP)
            except (BusUnavailable, BusFull) as error:
                log.warning("%s: waiting for Redis: %s", role.name, error)
                clock.wait("redis")
                time.sleep(RECONNECT_SLEEP)
    finally:
        role.close()
