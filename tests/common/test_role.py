"""The loop that every role shares: it goes on without Redis, and is closed whatever happens."""

import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.process.role import StopSignal, run_role


class Away(MemoryBus):
    """No metrics in, no word out."""

    def stop_requested(self):
        raise BusUnavailable("as told")


class Counting:
    """Ends after so many steps; every tenth needs the bus that is away."""

    name = "counting"

    def __init__(self, stop: StopSignal, steps: int, error: type[Exception] = BusUnavailable):
        self.stop, self.steps, self.error = stop, steps, error
        self.taken, self.closed = 0, False

    def step(self) -> bool:
        self.taken += 1
        if self.taken == self.steps:
            self.stop.request()
        if self.taken % 10 == 0:
            raise self.error("as told")
        return self.taken % 2 == 0

    def waiting_for(self) -> str:
        return "nothing"

    def metrics(self) -> dict[str, float]:
        return {"taken": self.taken}

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("error", [BusUnavailable, BusFull])
def test_steps_go_on_while_redis_is_away(monkeypatch, error):
    monkeypatch.setattr("rmc.common.process.role.RECONNECT_SLEEP", 0.01)
    stop = StopSignal()
    role = Counting(stop, 45, error)
    run_role(role, Away(), stop)
    assert (role.taken, role.closed) == (45, True)


def test_any_other_error_ends_it_closed():
    stop = StopSignal()
    role = Counting(stop, 45, RuntimeError)
    with pytest.raises(RuntimeError):
        run_role(role, MemoryBus(), stop)
    assert (role.taken, role.closed) == (10, True)


def test_says_its_metrics_and_hears_the_stop():
    bus, stop = MemoryBus(), StopSignal()
    bus.request_stop("enough")
    role = Counting(stop, 45)
    run_role(role, bus, stop)
    assert (role.taken, role.closed) == (0, True)
    bus.clear_stop()
    run_role(role, bus, stop, lambda: role.taken >= 5)
    assert bus.records({"counting": "0"})[0][-1].keys() >= {
        "time",
        "taken",
        "busy_share",
        "waiting_share",
        "waiting_for",
    }


def test_the_last_state_is_said_after_closing():
    stop, bus = StopSignal(), MemoryBus()
    role = Counting(stop, 7)
    run_role(role, bus, stop)
    assert role.closed
    assert bus.records({"counting": "0"})[0][-1]["taken"] == 7
