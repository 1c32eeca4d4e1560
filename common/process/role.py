"""A role and the loop that every role shares: stop signal, heartbeat metrics, waiting out Redis."""

import signal
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

from rmc.common.bus.protocol import Bus
from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.metrics import BusyClock
from rmc.common.process.outage import OutageLog

METRICS_PERIOD = 1.0  # seconds between a role's metrics records, which are its heartbeat too
STOP_PERIOD = 0.5  # seconds between looks at the bus's stop key
STOP_LOOKS = 3  # that find it: a Redis restored to an earlier start has that start's, until the launcher looks
TERMINATED_STATUS = 128 + signal.SIGTERM  # a shell's word for it
IDLE_SECONDS = 0.002  # slept after a step that had nothing to do
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
        """End cleanly: save what must be saved, leave nothing behind."""


class StopSignal:
    """Set by SIGTERM and SIGINT; the loop looks at it between steps."""

    def __init__(self) -> None:
        self.requested = self.terminated = False

    def install(self) -> None:
        """Catch both signals in this process, but for those that a program around Python has taken for itself.

        An ignored Ctrl-C stays ignored: a shell does so for what it starts by &.
        """
        if signal.getsignal(signal.SIGTERM) is not None:
            signal.signal(signal.SIGTERM, lambda *_: self._terminate())
        if signal.getsignal(signal.SIGINT) not in (None, signal.SIG_IGN):
            signal.signal(signal.SIGINT, lambda *_: self.request())

    def _terminate(self) -> None:
        self.requested = self.terminated = True

    @property
    def exit_status(self) -> int:
        """Of a role that has closed. After SIGTERM it is no end of the run: its launcher starts the role again."""
        return TERMINATED_STATUS if self.terminated else 0

    def request(self) -> None:
        self.requested = True


class Heartbeat:
    """What every role says and hears once in a while: its metrics, and whether the run should end."""

    def __init__(self, role: Role, bus: Bus, clock: BusyClock) -> None:
        self._role, self._bus, self._clock = role, bus, clock
        self.outage = OutageLog(role.name)
        self._next_metrics = self._next_stop = 0.0
        self._stops_seen = 0  # in a row
        self._unsent: dict[str, Any] = {}  # taken from the role, which does not say it twice

    def stop_requested(self) -> bool:
        """Whether the bus says so; while Redis is away the role goes on with what needs none."""
        now = time.monotonic()
        try:
            if now >= self._next_stop:
                self._next_stop = now + STOP_PERIOD
                self._stops_seen = self._stops_seen + 1 if self._bus.stop_requested() is not None else 0
                if self._stops_seen == STOP_LOOKS:
                    return True
            if now >= self._next_metrics:
                self._next_metrics = now + METRICS_PERIOD
                self._emit(self._unsent or self._metrics())
                self.outage.end()
        except (BusUnavailable, BusFull) as error:
            self.outage.begin(error)
            self._clock.wait("redis")
            self._next_stop = self._next_metrics = time.monotonic() + RECONNECT_SLEEP
        return False

    def close(self) -> None:
        """Close the role, whatever happens, and then say what it has to say last."""
        try:
            with suppress(BusUnavailable, BusFull):
                if self._unsent:  # older than what the role hands out as it closes
                    self._emit(self._unsent)
        finally:
            self._role.close()
        with suppress(BusUnavailable, BusFull):  # last, so that a Redis that hangs delays nothing
            self._emit(self._metrics())

    def _emit(self, record: dict[str, Any]) -> None:
        self._unsent = record
        self._bus.emit(self._role.name, record)
        self._unsent = {}

    def _metrics(self) -> dict[str, Any]:
        refused = {"refused_values": self._bus.refused.total()}
        return {**self._role.metrics(), **refused, **self._clock.shares()}


def run_role(
    role: Role,
    bus: Bus,
    stop: StopSignal,
    finished: Callable[[], bool] = lambda: False,
    idle_seconds: float = IDLE_SECONDS,
) -> None:
    """Step a role until it is stopped, fenced or finished; always closes it.

    It sleeps ``idle_seconds`` after a step that had nothing to do; 0 is for one that has waited itself. Redis away or
    full is waited out here; every other error ends the role.
    """
    clock = BusyClock()
    heartbeat = Heartbeat(role, bus, clock)
    try:
        while not (stop.requested or finished() or heartbeat.stop_requested()):
            try:
                if role.step():
                    clock.busy()
                else:
                    time.sleep(idle_seconds)
                    clock.wait(role.waiting_for())
            except (BusUnavailable, BusFull) as error:
                time.sleep(RECONNECT_SLEEP)
                heartbeat.outage.begin(error)
                clock.wait("redis")
    except BaseException:
        role.close()
        raise
    heartbeat.close()
