"""The loop that every role shares: it goes on without Redis, and is closed whatever happens."""

import signal

import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.role import STOP_LOOKS, StopSignal, run_role


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


def test_says_its_metrics_and_hears_the_stop(monkeypatch):
    monkeypatch.setattr("rmc.common.process.role.STOP_PERIOD", 0.0)
    asked, bus, stop = MemoryBus(), MemoryBus(), StopSignal()
    asked.request_stop("enough")
    role = Counting(stop, 45)
    run_role(role, asked, stop)
    assert (role.taken, role.closed) == (STOP_LOOKS - 1, True)
    run_role(role, bus, stop, lambda: role.taken >= 5)
    assert bus.records({"counting": "0"})[0][-1].keys() >= {"taken", "busy_share", "waiting_share", "waiting_for"}


def test_a_stop_that_a_launcher_takes_back_ends_nothing(monkeypatch):
    """As that of an earlier start, in a Redis that was restored to it."""
    stop, looks = StopSignal(), iter([*["enough"] * (STOP_LOOKS - 1), None] * 30)
    bus, role = MemoryBus(), Counting(stop, 30)
    monkeypatch.setattr(bus, "stop_requested", lambda: next(looks))
    monkeypatch.setattr("rmc.common.process.role.STOP_PERIOD", 0.0)
    run_role(role, bus, stop)
    assert role.taken == 30


def test_sigterm_is_no_end_in_order_and_ctrl_c_is():
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        for number, status in ((signal.SIGINT, 0), (signal.SIGTERM, 143)):
            stop = StopSignal()
            stop.install()
            signal.raise_signal(number)
            assert (stop.requested, stop.exit_status) == (True, status)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_the_last_state_is_said_after_closing():
    stop, bus = StopSignal(), MemoryBus()
    role = Counting(stop, 7)
    run_role(role, bus, stop)
    assert role.closed
    assert bus.records({"counting": "0"})[0][-1]["taken"] == 7


class Forgetful(Counting):
    """Says each number once."""

    def metrics(self) -> dict[str, float]:
        self.said = getattr(self, "said", 0) + 1
        return {"said": self.said}


class FullAtTimes(MemoryBus):
    """Refuses some records."""

    def __init__(self, refused: set[int]):
        super().__init__()
        self.tries, self.refused_tries = 0, refused

    def emit(self, role, record):
        self.tries += 1
        if self.tries in self.refused_tries:
            raise BusFull("as told")
        super().emit(role, record)


def test_it_is_closed_even_where_the_bus_refuses_its_last_words():
    class Refusing(FullAtTimes):
        def emit(self, role, record):
            self.tries += 1
            raise BusFull("as told") if self.tries == 1 else ConfigError("key", "x", "as told")

    stop = StopSignal()
    role = Counting(stop, 7)
    with pytest.raises(ConfigError):
        run_role(role, Refusing(set()), stop)
    assert role.closed


def test_what_it_hands_out_as_it_closes_comes_before_its_last_word():
    """Of an evaluator, evaluations that are newer than those that it has said."""
    stop, bus = StopSignal(), MemoryBus()

    class Late(Forgetful):
        def close(self) -> None:
            for _ in range(2):
                bus.emit(self.name, self.metrics())

    role = Late(stop, 7)
    run_role(role, bus, stop)
    said = [record["said"] for record in bus.records({"counting": "0"})[0]]
    assert said == sorted(said)
    assert len(said) == role.said >= 3


@pytest.mark.parametrize("refused", [set(), {1}, {1, 2}, {2}, {1, 3}])
def test_what_could_not_be_sent_is_sent_later_and_in_order(monkeypatch, refused):
    monkeypatch.setattr("rmc.common.process.role.METRICS_PERIOD", 0.02)
    monkeypatch.setattr("rmc.common.process.role.RECONNECT_SLEEP", 0.02)
    stop, bus = StopSignal(), FullAtTimes(refused)
    role = Forgetful(stop, 0, BusUnavailable)
    run_role(role, bus, stop, lambda: bus.tries >= 5)
    said = [record["said"] for record in bus.records({"counting": "0"})[0]]
    assert said == list(range(1, role.said + 1))


def test_what_is_still_unsent_at_the_end_comes_before_the_last_word(monkeypatch):
    stop, bus = StopSignal(), FullAtTimes({1})
    run_role(Forgetful(stop, 7), bus, stop)
    assert [record["said"] for record in bus.records({"counting": "0"})[0]] == [1, 2]
