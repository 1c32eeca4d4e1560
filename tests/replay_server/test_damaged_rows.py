"""Rows that a disk has changed are judged when they are drawn: neither the learner nor a counter sees them."""

import logging

import numpy as np
import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.errors import RmcError
from rmc.common.replay import SampleStatus
from rmc.common.window import Rows
from rmc.replay_server import row_check
from rmc.replay_server.row_check import FAULTS, FLOATS, row_faults
from tests.replay_server.support import SPEC, Make, close, filled, make_rows

WORDS = {  # field, value, and why a row with it can be none
    "last": (2**30 + 6, "last is outside (burn_in, T]"),
    "first": (1, "first is neither 0 nor burn_in"),
    "new_steps": (-5, "new_steps exceeds the trained steps"),
    "new_observations": (2**31 - 1, "new_observations is neither new_steps nor one more"),
    "episode_step": (-(2**31), "episode_step is negative"),
    "env": (-1, "env is negative"),
    "initial_priority": (-1.0, "initial_priority is negative"),
}
DAMAGE = [(name, value) for name, (value, _) in WORDS.items()]
THERE = [name for name in FLOATS if SPEC.dtype[name].itemsize]
DAMAGE += [("reward", np.inf), ("reward", -np.inf), *((name, np.nan) for name in THERE)]
DAMAGE += [("serial", 2**40), ("serial", -1), ("serial", 4)]
DAMAGE += [("reward", 5.0), ("terminated", 1), ("missing", 1)]  # of a row that could be one


@pytest.mark.parametrize(("name", "value"), DAMAGE)
def test_a_damaged_row_is_never_drawn(
    make: Make, bus: MemoryBus, name: str, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    server, _ = filled(make(), bus, 20)
    field = server._store.ring.rows[name]
    (field if field.ndim == 1 else field.reshape(len(field), -1)[:, -1])[3] = value
    with caplog.at_level(logging.WARNING):
        for number in range(1, 11):
            rows = server.sample(64).rows
            assert rows is not None
            assert not row_faults(rows, SPEC).any()
            assert sorted(set(rows["serial"].tolist())) == [serial for serial in range(20) if serial != 3]
            assert server.stats()["drawn_steps"] == number * 64 * SPEC.train
    assert server.stats()["damaged_windows"] == 1
    assert [record.getMessage().count("1 windows of the ring are damaged") for record in caplog.records] == [1]
    server.update_priorities(np.array([3]), np.array([1e9], np.float32))  # as drawn before it was damaged
    close(server)
    again = make()  # not after a restart either, though its priority is the largest
    assert again._store.tree.values(np.array([3])).tolist() == [0.0]


def test_a_ring_of_damaged_rows_alone_ends_its_server_and_the_next_begins_empty(make: Make, bus: MemoryBus) -> None:
    """Actors without credit would wait for the learner, and it for them."""
    server, _ = filled(make(), bus, 20)
    server._store.ring.rows["last"] = 10**9
    with pytest.raises(RmcError, match="every window of the ring is damaged"):
        server.sample(8)
    assert (server.stats()["drawn_steps"], server.stats()["draws"]) == (0, 0)
    assert server.stats()["damaged_windows"] == 20
    server.update_priorities(np.arange(20), np.ones(20, np.float32))
    assert server.sample(8).status is SampleStatus.WAIT
    close(server)
    again = make()
    assert again._store.ring.progress.inserted == 0
    assert again.sample(8).status is SampleStatus.WAIT


def test_an_episode_with_a_damaged_row_is_none(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 20)
    assert server.episode(5) is not None
    server._store.ring.rows["reward"][5, 1] = np.nan
    assert server.episode(5) is None
    assert server.stats()["damaged_windows"] == 1


def test_draws_of_sound_rows_are_as_they_were(make: Make, bus: MemoryBus) -> None:
    """What is damaged elsewhere changes no draw that does not meet it."""
    server, _ = filled(make(), bus, 20)
    first = server.sample(4).rows
    assert first is not None
    drawn, rest = first["serial"].tolist(), None
    close(server)
    again, _ = filled(make(folder="other", on=(other := MemoryBus())), other, 20)
    rest = next(serial for serial in range(20) if serial not in drawn)
    again._store.ring.rows["last"][rest] = -1
    rows = again.sample(4).rows
    assert rows is not None
    assert rows["serial"].tolist() == drawn


def slow_faults(rows: Rows) -> list[str]:
    """The same judgement, row by row and as it is said."""
    refused = []
    for row in rows:
        first, last, new, seen = (int(row[name]) for name in ("first", "last", "new_steps", "new_observations"))
        faults = {
            FAULTS[1]: first not in (0, SPEC.burn_in),
            FAULTS[2]: not SPEC.burn_in < last <= SPEC.steps,
            FAULTS[3]: not 0 <= new <= last - SPEC.burn_in,
            FAULTS[4]: first == 0 and row["episode_step"] < SPEC.burn_in,
            FAULTS[5]: seen not in (new, new + 1),
            FAULTS[6]: row["env"] < 0,
            FAULTS[7]: row["episode_step"] < 0,
            FAULTS[8]: row["initial_priority"] < 0,
            **{f"{name} is not finite": not np.isfinite(row[name]).all() for name in FLOATS},
        }
        refused.append(next((fault for fault, is_so in faults.items() if is_so), ""))
    return refused


def test_flipped_bits_are_judged_as_a_loop_judges_them() -> None:
    random, rows = np.random.default_rng(3), make_rows(4000)
    rows["observation"][::7] = 3e38  # large, and finite
    raw = rows.view(np.uint8).reshape(len(rows), -1)
    raw[np.arange(4000), random.integers(raw.shape[1], size=4000)] ^= 1 << random.integers(8, size=4000).astype(
        np.uint8
    )
    assert [FAULTS[fault] for fault in row_faults(rows, SPEC)] == slow_faults(rows)
    assert 100 < np.count_nonzero(row_faults(rows, SPEC)) < 3000


@pytest.mark.parametrize(("name", "value", "fault"), [(name, *values) for name, values in WORDS.items()])
def test_a_fault_has_its_name(name: str, value: float, fault: str) -> None:
    rows = make_rows(5)
    rows[name][2] = value
    assert [FAULTS[code] for code in row_faults(rows, SPEC)] == ["", "", fault, "", ""]


def test_the_first_and_the_last_that_can_be_are_taken() -> None:
    rows = make_rows(10)
    rows["first"][:2], rows["episode_step"][:2] = 0, [SPEC.burn_in - 1, SPEC.burn_in]
    rows["new_steps"] = rows["new_observations"] = [1] * 4 + [3, 2, 2, 2, 2, 2]
    rows["last"][2:6] = [SPEC.burn_in, SPEC.burn_in + 1, SPEC.burn_in + 2, SPEC.burn_in + 2]
    rows["new_observations"][6:] = [1, 2, 3, 4]
    assert [FAULTS[fault] for fault in row_faults(rows, SPEC)] == slow_faults(rows)
    assert np.flatnonzero(row_faults(rows, SPEC)).tolist() == [0, 2, 4, 6, 9]


@pytest.mark.parametrize("value", [3e38, np.nan, np.inf, -1.0, 0.0, 9.0])
def test_a_priority_beyond_the_largest_seen_is_not_believed_after_a_restart(
    make: Make, bus: MemoryBus, value: float
) -> None:
    """It would be all that is drawn."""
    server, _ = filled(make(), bus, 20)
    server.update_priorities(np.arange(20), np.linspace(1.0, 8.0, 20).astype(np.float32))
    server._store.priorities[3] = value
    close(server)
    again = make()
    assert again._store.priorities[3] == 8.0
    assert again._store.priorities[19] == 8.0
    assert again._store.priorities[0] == 1.0


def test_huge_numbers_whose_sum_overflows_are_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of a window of millions would."""
    monkeypatch.setattr(row_check, "TINY", np.float32(1.0))
    row_check._columns.cache_clear()
    rows = make_rows(3)
    rows["observation"][1] = 3e38
    assert not row_faults(rows, SPEC).any()
    row_check._columns.cache_clear()
