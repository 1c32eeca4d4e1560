"""The replay server without its socket: intake, credit, draws, statistics."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Bus, EntryId, Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusFull, BusUnavailable, FencedError
from rmc.common.replay import ObservationStatistics, SampleStatus
from rmc.common.window import WindowSpec
from rmc.common.wire import encode_windows
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.observation_sums import observation_sums
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.stream_reader import MAX_ENTRIES, MOST_ASKED
from rmc.replay_server.sum_tree import SumTree
from tests.learner.rows import observation_valid
from tests.replay_server.support import OPEN, SPEC, Make, Sender, close, drain, filled, make_rows, stored


def test_origin_and_serial_come_from_the_entry_id(make: Make, bus: MemoryBus) -> None:
    server, senders = make(), [Sender(bus, 0), Sender(bus, 1)]
    for name in ("serial", "seq", "actor", "epoch", "k"):
        rows = make_rows(3)
        rows[name] = -99
        senders[1].send_rows(rows)
    senders[0].send(2)
    drain(server)
    rows = stored(server)
    assert rows["actor"].tolist() == [0] * 2 + [1] * 15
    assert rows["seq"].tolist() == [1, 1] + [seq for seq in range(1, 6) for _ in range(3)]
    assert rows["k"].tolist() == [0, 1] + [0, 1, 2] * 5
    assert (rows["epoch"] == 1).all()
    assert server.stats()["entry_gaps"] == 0


def test_an_old_window_makes_room_and_its_priority_is_dropped(make: Make, bus: MemoryBus) -> None:
    server, sender = make(ReplayConfig(capacity=10, replay_ratio=1e6, warmup_steps=0)), Sender(bus)
    for count in (4, 4, 4):
        sender.send(count)
        drain(server)
    assert stored(server)["reward"][:, 0].tolist() == list(range(2, 12))
    server.update_priorities(np.array([0, 1, 2, 11, 12]), np.array([9, 9, 3, 4, 9], np.float32))
    assert server.stats()["evicted_priorities"] == 3
    assert server.stats()["max_priority"] == 4.0
    leaves = server._store.tree.values(np.arange(10))
    assert leaves.tolist() == pytest.approx([1, 4**0.6, 3**0.6, 1, 1, 1, 1, 1, 1, 1])
    server.update_priorities(np.array([5, 6, 7]), np.array([np.nan, np.inf, -1], np.float32))
    assert server.stats()["refused_priorities"] == 3
    assert np.array_equal(server._store.tree.values(np.arange(10)), leaves)


def test_an_entry_larger_than_the_ring(make: Make, bus: MemoryBus) -> None:
    server, sender = make(ReplayConfig(capacity=5, replay_ratio=1e6, warmup_steps=0)), Sender(bus)
    sender.send(3)
    sender.send(12)
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [10, 11, 12, 13, 14]
    assert server.stats()["env_steps"] == 15 * SPEC.train


def test_new_windows_enter_with_their_own_or_the_largest_priority(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(), bus, 2)
    server.update_priorities(np.array([0, 1]), np.array([0.5, 6.0], np.float32))
    rows = make_rows(3)
    rows["initial_priority"] = [0, 2, 0]
    sender.send_rows(rows)
    drain(server)
    assert server._store.priorities[:5].tolist() == [0.5, 6.0, 6.0, 2.0, 6.0]


def test_slots_that_hold_no_window_raise_no_new_windows_priority(make: Make, bus: MemoryBus) -> None:
    """They hold 1 from the start, while temporal differences may all be far below."""
    server, sender = filled(make(), bus, 2)
    server.update_priorities(np.array([0, 1]), np.array([0.5, 0.25], np.float32))
    sender.send(1)
    drain(server)
    assert server._store.priorities[:3].tolist() == [0.5, 0.25, 0.5]


def test_an_overwritten_window_raises_no_new_windows_priority(make: Make, bus: MemoryBus) -> None:
    server, sender = make(dataclasses.replace(OPEN, capacity=4)), Sender(bus)
    sender.send(4)
    drain(server)
    server.update_priorities(np.arange(4), np.array([100.0, 1.0, 2.0, 0.5], np.float32))
    sender.send(1)
    drain(server)
    assert server._store.priorities.tolist() == [2.0, 1.0, 2.0, 0.5]
    assert server.stats()["max_priority"] == 2.0


def test_a_priority_that_was_corrected_is_no_new_windows(make: Make, bus: MemoryBus) -> None:
    """As a learner gives that diverges, and begins again at its last checkpoint."""
    server, sender = filled(make(), bus, 4)
    server.update_priorities(np.arange(4), np.array([0.5, 1e20, 2.0, 0.1], np.float32))
    server.update_priorities(np.array([1]), np.array([0.25], np.float32))
    close(server)
    server = make()
    sender.send(2)
    drain(server)
    assert server._store.priorities[:6].tolist() == pytest.approx([0.5, 0.25, 2.0, 0.1, 2.0, 2.0])
    assert server.stats()["max_priority"] == 2.0


def test_a_priority_that_came_back_before_a_kill_is_kept(make: Make, bus: MemoryBus) -> None:
    """Though nothing was drawn or taken in between."""
    server, _ = filled(make(), bus, 5)
    server.update_priorities(np.arange(5), np.array([0.5, 50.0, 7.0, 3.0, 0.25], np.float32))
    os.close(server._store.lock)
    server._store.lock = -1
    assert make()._store.priorities[:5].tolist() == [0.5, 50.0, 7.0, 3.0, 0.25]


def test_values_are_what_windows_are_drawn_by(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 20)
    priorities = np.random.default_rng(0).exponential(size=20).astype(np.float32)
    server.update_priorities(np.arange(20), priorities)
    sample = server.sample(64)
    assert sample.rows is not None
    scaled = priorities.astype(float) ** 0.6
    np.testing.assert_allclose(sample.weights, scaled[sample.rows["serial"]])
    assert sample.total_weight == pytest.approx(scaled.sum())
    assert sample.drawn_steps == 64 * SPEC.train


def test_exponent_zero_is_uniform(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=100, replay_ratio=1e6, warmup_steps=0, priority_exponent=0.0)
    server, _ = filled(make(config), bus, 50)
    server.update_priorities(np.arange(50), np.linspace(1e-6, 1e6, 50).astype(np.float32))
    counts = np.zeros(50)
    for _ in range(40):
        sample = server.sample(50)
        assert sample.rows is not None
        assert (sample.weights == 1).all()
        counts += np.bincount(sample.rows["serial"], minlength=50)
    assert (counts == 40).all()  # 50 strata over 50 equal windows


def test_uniform_replay_looks_for_no_largest_priority(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SumTree, "leaves", Mock(side_effect=AssertionError))
    filled(make(dataclasses.replace(OPEN, priority_exponent=0.0)), bus, 2)


def test_statistics_against_a_loop_and_padding_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    rows = make_rows(200)
    rows["first"] = rng.choice([0, SPEC.burn_in], 200)
    rows["last"] = rng.integers(SPEC.burn_in + 1, SPEC.steps + 1, 200)
    rows["new_steps"] = rng.integers(0, rows["last"] - SPEC.burn_in + 1)
    rows["new_observations"] = rows["new_steps"] + rng.integers(0, 2, 200)
    rows["missing"] = rng.random(rows["missing"].shape) < 0.4
    expected = [
        row["observation"][t].astype(float)
        for row in rows
        for t in range(row["last"] - row["new_observations"] + 1, row["last"] + 1)
        if not row["missing"][t].any()
    ]
    none = ObservationStatistics.none(SPEC)
    sums = observation_sums(rows, SPEC, none)
    assert sums.count == len(expected)
    np.testing.assert_allclose(sums.total, np.sum(expected, axis=0), rtol=1e-9)
    np.testing.assert_allclose(sums.total_square, np.sum(np.square(expected), axis=0), rtol=1e-9)
    rows["observation"][~observation_valid(rows, SPEC)] = np.nan
    rows["observation"][rows["missing"][..., 0] == 1] = 1e30
    again = observation_sums(rows, SPEC, none)
    assert again.count == sums.count
    assert np.array_equal(again.total, sums.total)
    assert np.array_equal(again.total_square, sums.total_square)


def test_statistics_by_number_leave_out_what_is_missing_alone() -> None:
    spec, rng = WindowSpec(3, 2, 4, burn_in=2, train=4, missing=3, privileged=2), np.random.default_rng(5)
    rows = make_rows(50, spec=spec)
    rows["missing"] = rng.random(rows["missing"].shape) < 0.4
    rows["privileged"] = rng.normal(size=rows["privileged"].shape)
    new = np.s_[:, -spec.train :]
    seen = rows["missing"][new] == 0
    observed, privileged = (rows[name][new].astype(float) for name in ("observation", "privileged"))
    sums = observation_sums(rows, spec, ObservationStatistics.none(spec))
    assert sums.count.tolist() == [*seen.sum((0, 1)), *[50 * spec.train] * 2]
    expected = np.concatenate([(observed * seen).sum((0, 1)), privileged.sum((0, 1))])
    np.testing.assert_allclose(sums.total, expected, rtol=1e-9)
    expected = np.concatenate([(observed**2 * seen).sum((0, 1)), (privileged**2).sum((0, 1))])
    np.testing.assert_allclose(sums.total_square, expected, rtol=1e-9)


def deviation(sums: ObservationStatistics) -> list[float]:
    mean = sums.total / sums.count
    return np.sqrt(sums.total_square / sums.count - mean**2).tolist()


@pytest.mark.parametrize("spoilt", [1, 8])
def test_one_huge_number_does_not_blind_the_statistics(spoilt: int) -> None:
    """Early or late. Nor does a number that was constant for long stay one."""
    rng, sums = np.random.default_rng(5), ObservationStatistics.none(SPEC)
    for part in range(12):
        rows = make_rows(100)
        rows["observation"] = rng.normal(size=rows["observation"].shape)
        rows["observation"][..., 1] *= 1e3 if part >= 6 else 0.0
        rows["observation"][50, -1, 0] = 1e8 if part == spoilt else 0.0
        sums += observation_sums(rows, SPEC, sums)
    assert deviation(sums)[0] < 2.5  # of 4 800, that one counts as 100 of its deviations
    assert 500.0 < deviation(sums)[1] < 1e3 * 0.5**0.5  # its first part counts as too small


def test_statistics_survive_a_restart_and_count_once(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 8)
    expected = observation_sums(make_rows(8), SPEC, ObservationStatistics.none(SPEC))
    close(server)
    statistics = make().statistics()
    assert statistics.count == expected.count == 8 * SPEC.train
    assert np.array_equal(statistics.total, expected.total)
    assert np.array_equal(statistics.total_square, expected.total_square)


def test_draws_follow_from_seed_number_and_ring_alone(make: Make, tmp_path: Path) -> None:
    """Twins: one restarted twice in between, one not, one with another seed."""

    def play(server: ReplayServer, bus: MemoryBus, again: Callable[[], ReplayServer]) -> list[bytes]:
        sender, drawn = Sender(bus), []
        for number in range(6):
            sender.send(9)
            drain(server)
            for _ in range(3):
                sample = server.sample(16)
                assert sample.rows is not None
                assert sample.weights is not None
                drawn.append(sample.rows.tobytes() + sample.weights.tobytes())
                server.update_priorities(sample.rows["serial"].copy(), sample.rows["reward"][:, 0] + 1)
            if number % 2:
                server.checkpoint()
                server = again()
        return drawn

    buses = [MemoryBus() for _ in range(3)]
    first, steady = make(folder="a", on=buses[0]), make(folder="b", on=buses[1])

    def restarted() -> ReplayServer:
        nonlocal first
        close(first)
        first = make(folder="a", on=buses[0])
        return first

    drawn = play(first, buses[0], restarted)
    assert drawn == play(steady, buses[1], lambda: steady)
    other = make(folder="c", on=buses[2], seed=8)
    assert drawn != play(other, buses[2], lambda: other)


def test_rows_stay_until_the_next_draw_but_one(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 50)
    samples, copies = [], []
    for _ in range(3):
        samples.append(server.sample(8).rows)
        copies.append(samples[-1].copy())
        for rows, copy in list(zip(samples, copies, strict=True))[-2:]:
            assert np.array_equal(rows, copy)
    assert np.shares_memory(samples[0], samples[2])
    assert not np.shares_memory(samples[0], samples[1])


def test_the_limiter_holds_draws_and_credit(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=1000, replay_ratio=2.0, warmup_steps=40)
    server, senders = make(config, total=200, slack=16), [Sender(bus, 0), Sender(bus, 1)]
    drain(server)
    assert [sender.granted() for sender in senders] == [28, 28]  # (40 + 16) / 2 each
    assert server.sample(4).status is SampleStatus.WAIT
    assert (server.stats()["learner_waiting_for"], server.waiting_for()) == ("warm-up", "windows")
    senders[0].send(5)
    drain(server)
    assert [sender.granted() for sender in senders] == [20 + 18, 18]
    senders[1].send(9)
    drain(server)
    assert [sender.granted() for sender in senders] == [20, 36]  # 56 of 56 are in
    assert server.waiting_for() == "draws"
    draws = 0
    while server.sample(4).status is SampleStatus.BATCH:
        draws += 1
    assert draws == (16 * 2 + 16 * 2 + 16) // 16  # the steps past the warm-up, the slack's worth, one batch
    assert (server.stats()["learner_waiting_for"], server.waiting_for()) == ("env_steps", "windows")
    server.step()  # nothing came in, but the learner waits, so the credit of its draws is published
    headroom = 40 + draws * 16 // 2 + 16 - 56
    assert [sender.granted() for sender in senders] == [20 + headroom // 2, 36 + headroom // 2]


def test_small_credit_is_published_late_but_at_once_where_the_learner_waits(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=1000, replay_ratio=100.0, warmup_steps=0)
    server, sender, published = make(config, actors=1, slack=800), Sender(bus), set()
    sender.send(1)
    drain(server)
    draws = 20
    for _ in range(draws):
        server.sample(64)
    sender.send(1)
    drain(server)  # this publishes all of it; from here on only every hundred steps or so
    while server.sample(64).status is SampleStatus.BATCH:
        published.add(sender.granted())
        draws += 1
        server.step()
    assert draws > 300
    assert len(published) < 10
    assert sender.granted() < draws * 256 // 100 + 800
    server.step()
    assert sender.granted() == draws * 256 // 100 + 800


def test_the_first_credit_is_said_once(make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus, "commit", commit := Mock(wraps=bus.commit))
    server, _ = make(), Sender(bus)
    server.step()
    assert commit.call_count == 1
    assert bus.ack(0) is not None


def test_the_clock_repeats_what_was_published_and_no_more(make: Make, bus: MemoryBus) -> None:
    """Or in lockstep it would decide when an actor may step."""
    config = ReplayConfig(capacity=1000, replay_ratio=100.0, warmup_steps=0)
    server, sender = filled(make(config, actors=1, slack=800), bus, 2)
    server.sample(64)
    before = sender.granted()
    for _ in range(2):
        server._credit._republish_at = 0.0
        server.step()
        assert sender.granted() == before


def test_the_end_is_announced_and_reached(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=1000, replay_ratio=2.0, warmup_steps=8)
    server, sender = filled(make(config, actors=1, total=400, slack=16), bus, 2)
    ack = bus.ack(0)
    assert ack is not None
    assert not ack.final
    sent, outcomes = 2, []
    while (draw := server.sample(4).status) is not SampleStatus.FINISHED:
        outcomes.append(draw)
        if draw is SampleStatus.WAIT:
            drain(server)
            assert sender.granted() > sent * SPEC.train
            sender.send(1)
            sent += 1
            drain(server)
    ack = bus.ack(0)
    assert ack is not None
    assert ack.final
    assert ack.granted_steps == server.stats()["env_steps"] == 400
    owed, tolerance = (400 - 8) * 2 // 16, (16 * 2 + 16) // 16
    assert owed <= outcomes.count(SampleStatus.BATCH) <= owed + tolerance
    assert server.stats()["replay_ratio"] == outcomes.count(SampleStatus.BATCH) * 16 / (400 - 8)


def test_an_empty_ring_makes_the_learner_wait(make: Make) -> None:
    assert make().sample(4).status is SampleStatus.WAIT


def test_a_new_life_counts_from_zero(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(ReplayConfig(capacity=100, replay_ratio=1.0, warmup_steps=100)), bus, 5)
    assert sender.granted() == 20 + (116 - 20) // 2
    sender.hello()
    assert sender.epoch == 2
    drain(server)
    assert sender.granted() == (116 - 20) // 2
    sender.send(1)
    drain(server)
    assert sender.granted() == 4 + (116 - 24) // 2
    with pytest.raises(FencedError):
        bus.append(0, EntryId(1, 6), b"")
    assert stored(server)["epoch"].tolist() == [1] * 5 + [2]


def test_an_actor_beyond_the_number_started_is_taken_in_without_credit(make: Make, bus: MemoryBus) -> None:
    server = make()
    drain(server)
    sender = Sender(bus, actor=9)
    sender.send(3)
    for _ in range(200):  # found within some rounds
        server.step()
    assert stored(server)["actor"].tolist() == [9, 9, 9]
    assert sender.granted() == 3 * SPEC.train


def test_bad_entries_are_put_aside_counted_and_cost_no_credit(make: Make, redis_url: str, run_name: str) -> None:
    bus = RedisBus(redis_url, run_name)
    server, sender = make(ReplayConfig(capacity=100, replay_ratio=1.0, warmup_steps=100), actors=1, on=bus), Sender(bus)
    good = encode_windows(make_rows(3), SPEC)
    nan = make_rows(3)
    nan["reward"][1] = np.nan
    early = make_rows(3)
    early["first"][1] = 0  # a burn-in from before the episode
    bad = [b"", b"\x00" * 50, good[:-1], good[:-1] + b"\xff", b"\xc1" * (2 << 20)]
    bad += [encode_windows(rows, SPEC) for rows in (nan, early)]
    for payload in bad:
        sender.send_raw(payload)
        sender.send(1)
    drain(server)
    stats = server.stats()
    assert max(len(fields[b"head"]) for _, fields in bus.redis.xrange(f"rmc:{run_name}:dead")) == 1024
    assert stats["dead_letters"] == len(bad) == bus.redis.xlen(f"rmc:{run_name}:dead")
    assert stats["dead_letters_crc"] == 1
    assert stats["dead_letters_window"] == 2
    assert stats["dead_letters_too-large"] == 1
    assert stats["env_steps"] == len(bad) * SPEC.train
    assert stored(server)["reward"][:, 0].tolist() == list(range(len(bad)))
    lost = 4 * 3 * SPEC.train  # what the sender counts in the four that were whole in size, at least
    assert sender.granted() >= lost + stats["env_steps"] + 116 - stats["env_steps"]
    assert bus.ack(0) is not None
    assert bus.redis.xlen(f"rmc:{run_name}:windows:0") == 0  # trimmed


def assert_resent(sender: Sender, server: ReplayServer) -> None:
    """After two windows, the actor sends again the one that Redis lost and the one behind it."""
    sender.greet()
    sender.seq = 1
    for mark in (2, 3):
        sender.send_rows(make_rows(1, mark))
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("kind", ["memory", "redis"])
def test_what_a_stream_lacks_is_sent_again(make: Make, kind: str, redis_url: str, run_name: str) -> None:
    bus: Bus = MemoryBus() if kind == "memory" else RedisBus(redis_url, run_name)
    server, sender = filled(make(on=bus), bus, 2)
    sender.seq += 1  # entry 2 is what Redis lost
    sender.send_rows(make_rows(1, 3))
    drain(server)
    assert server.stats()["entry_gaps"] == 1
    assert len(stored(server)) == 2
    assert bus.ack(0) is not None
    with pytest.raises(BusUnavailable, match="gone"):
        sender.send(1)
    assert_resent(sender, server)
    assert server.stats()["entry_gaps"] == 1
    assert sender.granted() > 0


def test_a_round_reads_a_few_large_entries_or_many_small_ones(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, sender, asked, read = make(actors=1), Sender(bus), [], bus.read
    monkeypatch.setattr(bus, "read", lambda cursors, count: asked.append(count) or read(cursors, count))
    for payload in (b"\xc1" * (1 << 20), b"\xc1"):
        sender.send_raw(payload)
        drain(server)
        server.step()
        assert asked[-1] == (3 if len(payload) > 1 else MAX_ENTRIES)


def test_what_redis_loses_again_is_sent_again(make: Make, bus: MemoryBus) -> None:
    """An append-only file may come back without its last second twice before anything is read."""
    server, sender = filled(make(), bus, 2)
    for _ in range(2):
        sender.greet()
        sender.seq = 2  # entry 2 is what Redis lost
        sender.send_rows(make_rows(1, 3))
        drain(server)
        assert len(stored(server)) == 2
    assert_resent(sender, server)
    assert server.stats()["entry_gaps"] == 1


def forge(bus: RedisBus, entry_id: EntryId) -> None:
    """An entry as whoever has the actor's login can add one."""
    bus.redis.xadd(
        f"{bus.prefix}:windows:0", {"p": encode_windows(make_rows(1), SPEC)}, id=f"{entry_id.epoch}-{entry_id.seq}"
    )


FORGED = [
    (2**64 - 1, 2**64 - 1),
    (2**31 - 1, 2**53),
    (2**31 - 1, 0),
    (2**20, 0),
    (2, 0),
    (1, 2**53),
    (1, 2**41),
    (1, 2**21),
]


@pytest.mark.parametrize(
    ("forged", "counted"),
    [(one, counted) for one in FORGED for counted in (1, 2**40) if counted == 1 or one != (2, 0)],  # a life that begun
)
def test_an_id_that_no_life_can_have_reached_is_refused_and_the_actor_goes_on(
    make: Make, redis_url: str, run_name: str, forged: tuple[int, int], counted: int
) -> None:
    bus = RedisBus(redis_url, run_name)
    server, sender = filled(make(on=bus), bus, 2)
    sender.send(1)
    for _ in range(2):  # as often as somebody does it
        bus.redis.set(f"{bus.prefix}:epoch:actor-0", counted)
        forge(bus, EntryId(*forged))
        drain(server)
        sender.greet()
        sender.seq = 2
        sender.send(1)  # what was sent since is kept, and sent again
    drain(server)
    stats = server.stats()
    assert (stats["dead_letters_id"], stats["entry_gaps"]) == (2, 0)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 2, 3]
    assert bus.ack(0) is not None
    close(server)

    fresh = MemoryBus()  # a resume with an empty Redis, and the actor's next life
    again, sender = make(on=fresh), Sender(fresh)
    sender.epoch = fresh.take_epoch("actor-0", floor=server._store.ring.progress.streams[0].id.epoch)
    sender.greet()
    sender.send_rows(make_rows(1, 9))
    drain(again)
    assert stored(again)["reward"][-1, 0] == 9


class Failing(MemoryBus):
    """One call of the named methods fails."""

    def __init__(self, *names: str) -> None:
        super().__init__()
        for name in names:
            setattr(self, name, self._once(getattr(self, name)))
        self.failing = False

    def _once(self, method: Callable[..., Any]) -> Callable[..., Any]:
        failed = False

        def call(*args: Any) -> Any:
            nonlocal failed
            if self.failing and not failed:
                failed = True
                raise BusUnavailable("away")
            return method(*args)

        return call


def test_what_a_stream_lacks_is_asked_for_again_where_redis_went_away_amid_asking(make: Make) -> None:
    bus = Failing("drop_stream")
    server, sender = filled(make(on=bus), bus, 2)
    sender.seq += 1  # entry 2 is what Redis lost
    sender.send_rows(make_rows(1, 3))
    bus.failing = True
    with pytest.raises(BusUnavailable):
        drain(server)
    drain(server)
    assert len(stored(server)) == 2
    assert server.stats()["entry_gaps"] == 1
    assert_resent(sender, server)


@pytest.mark.parametrize("away", ["commit", "latest_version"])
def test_what_redis_did_not_hear_is_said_when_it_is_back(make: Make, away: str) -> None:
    bus = Failing(away)
    server, sender = make(on=bus, slack=1000), Sender(bus)  # so much that two windows' credit alone would wait
    drain(server)
    sender.send(2)
    bus.failing = True
    with pytest.raises(BusUnavailable):
        drain(server)
    drain(server)  # nothing new came
    ack = bus.ack(0)
    assert ack is not None
    assert ack.id == EntryId(1, 1)
    assert bus.read({0: EntryId(0, -1)}, 10) == []


def test_what_an_error_left_half_inserted_is_taken_in_once(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, sender = filled(make(), bus, 3)
    sender.send(2)
    monkeypatch.setattr(server._store, "set_priorities", Mock(side_effect=MemoryError))
    with pytest.raises(MemoryError):
        server.step()
    close(server)  # as the role's loop does
    again = make()
    drain(again)
    assert stored(again)["reward"][:, 0].tolist() == list(range(5))
    assert again.stats()["env_steps"] == 5 * SPEC.train


class Late(MemoryBus):
    """Redis that, where ``late``, carries a commit out after its caller has given up."""

    def __init__(self) -> None:
        super().__init__()
        self.late, self.heard = False, list[EntryId]()

    def commit(self, *args: Any) -> None:
        super().commit(*args)
        self.heard += [self._acks[0].id] if 0 in self._acks else []
        if self.late:
            self.late = False
            raise BusUnavailable("away")


def test_no_ack_goes_back_after_a_commit_whose_answer_was_late(make: Make) -> None:
    server, sender = filled(make(on=(bus := Late())), bus, 2)
    sender.send(2)
    bus.late = True
    with pytest.raises(BusUnavailable):
        drain(server)
    server._credit._republish_at = 0.0
    drain(server)
    assert bus.heard == sorted(bus.heard)
    assert bus.heard[-1] == EntryId(1, 2)


def test_what_redis_did_not_hear_twice_is_said_at_once_when_it_is_back(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, sender = filled(make(), bus, 2)
    sender.send(2)
    with monkeypatch.context() as away:
        away.setattr(bus, "commit", Mock(side_effect=BusUnavailable("away")))
        for _ in range(2):
            with pytest.raises(BusUnavailable):
                server.step()
    server.step()
    assert bus.ack(0) == server._credit._published[0]
    assert server._credit._published[0].id == EntryId(1, 2)


def test_what_is_refused_is_refused_once_though_redis_goes_away(make: Make) -> None:
    bus = Failing("commit")
    server, sender = make(on=bus), Sender(bus)
    drain(server)
    sender.send_raw(b"junk")
    bus.failing = True
    with pytest.raises(BusUnavailable):
        drain(server)
    drain(server)
    assert server.stats()["dead_letters"] == len(bus.dead_letters) == 1


def test_what_is_refused_while_redis_is_full_keeps_nobody_waiting(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the commit after it makes room."""
    server, sender = make(), Sender(bus)
    monkeypatch.setattr(bus, "dead_letter", Mock(side_effect=BusFull("full")))
    sender.send_raw(b"junk")
    sender.send(2)
    drain(server)
    assert (server.stats()["dead_letters"], len(stored(server))) == (1, 2)
    assert bus.read({0: EntryId(0, -1)}, 10) == []


@pytest.mark.parametrize("bad", [EntryId(2**64 - 1, 2**64 - 1), EntryId(1, 2**63), EntryId(2**31, 0)])
def test_an_id_past_all_others_closes_a_stream_to_nobody(make: Make, bus: MemoryBus, bad: EntryId) -> None:
    server, sender = filled(make(), bus, 2)
    bus.append(0, bad, b"anything")
    drain(server)
    assert server.stats()["dead_letters_id"] == 1
    with pytest.raises(BusUnavailable, match="gone"):
        sender.send(1)
    sender.greet()
    sender.seq = 1
    sender.send(1)
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 2]


def test_what_its_actor_lacks_too_is_given_up(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(), bus, 2)
    for _ in range(1 + MOST_ASKED):  # what it keeps starts at entry 6, also when it was asked to send again
        sender.greet()
        sender.seq = 5
        sender.send_rows(make_rows(1, 5))
        drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 5]
    assert server.stats()["entry_gaps"] == 1
    sender.seq += 1  # and lacks another one
    sender.send_rows(make_rows(1, 7))
    drain(server)
    assert server.stats()["entry_gaps"] == 2


def test_policy_lag_is_measured(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    bus.publish_weights(Version(1, 50), b"")
    for updates in ([20, 40], [30, 50]):
        rows = make_rows(2)
        rows["weights_update"] = updates
        sender.send_rows(rows)
        drain(server)
    metrics = server.metrics()
    assert metrics["policy_lag_mean"] == 15
    assert metrics["policy_lag_max"] == 30
    assert metrics["windows"] == 4
    assert "policy_lag_max" not in server.metrics()
    sender.send_rows(rows)
    drain(server)
    assert server.metrics()["policy_lag_max"] == 20
    rows["weights_update"] = 60  # of updates that a kill undid
    sender.send_rows(rows)
    drain(server)
    metrics = server.metrics()
    assert (metrics["policy_lag_mean"], metrics["policy_lag_max"]) == (0, 0)


@pytest.mark.parametrize("ratio", [1.0, 64.0])
def test_a_changed_ratio_counts_from_there(ratio: float, make: Make, bus: MemoryBus) -> None:
    """Neither does the learner owe updates for what was, nor does anybody wait for it; and so after a restart."""
    slack, batch = 16, 4 * SPEC.train
    before = ReplayConfig(capacity=100, replay_ratio=8.0, warmup_steps=40)
    server, sender = make(before), Sender(bus)
    for _ in range(30):
        sender.send(4)
        drain(server)
        while server.sample(4).status is SampleStatus.BATCH:
            pass
    close(server)
    changed, count = ReplayConfig(capacity=100, replay_ratio=ratio, warmup_steps=40), 0
    for _ in range(3):  # the first start with it, and two more
        server = make(changed)
        assert server.stats()["credit_steps"] > 0  # actors may step at once
        for _ in range(10):
            sender.send(4)
            drain(server)
            while server.sample(4).status is SampleStatus.BATCH:
                count += 1
            assert server.waiting_for() == "windows"
        stats = server.stats()
        allowed = (stats["env_steps"] - 480) * ratio  # from where it changed
        assert allowed - batch <= count * batch <= allowed + slack * ratio + batch
        assert not stats["replay_ratio_off"]
        close(server)


def test_a_ratio_that_changes_in_the_warm_up_changes_nothing_else(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(ReplayConfig(capacity=100, replay_ratio=8.0, warmup_steps=40)), bus, 4)
    close(server)
    server = make(ReplayConfig(capacity=100, replay_ratio=2.0, warmup_steps=40))
    assert server.sample(4).status is SampleStatus.WAIT
    sender.send(6)
    drain(server)
    assert server.sample(4).status is SampleStatus.BATCH


def test_a_ring_that_does_not_say_its_ratio_counts_from_where_it_is_opened(make: Make, bus: MemoryBus) -> None:
    """As those of config format 1."""
    config = ReplayConfig(capacity=100, replay_ratio=8.0, warmup_steps=0)
    server, sender = make(config), Sender(bus)
    for _ in range(10):
        sender.send(4)
        drain(server)  # 160 steps, for which nothing is drawn
    server._store.ring.progress.replay_ratio = 0.0
    close(server)
    drawn = 0
    server = make(config)
    while server.sample(4).status is SampleStatus.BATCH:
        drawn += 4 * SPEC.train
    assert drawn <= 16 * 8.0 + 4 * SPEC.train


def test_a_priority_of_nothing_keeps_a_chance(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 3)
    server.update_priorities(np.array([0, 1]), np.array([0.0, 1e-30], np.float32))
    assert server.stats()["refused_priorities"] == 0
    assert server._store.priorities[:3].tolist() == pytest.approx([1e-6, 1e-6, 1.0])
    assert (server._store.tree.values(np.arange(3)) > 0).all()


def test_only_real_trained_steps_count_as_drawn(make: Make, bus: MemoryBus) -> None:
    """Else the ratio would not be held where episodes end within a window."""
    server, sender = make(), Sender(bus)
    rows = make_rows(6)
    rows["last"] = SPEC.burn_in + np.array([1, 2, 3, 4, 1, 2])
    rows["new_steps"] = rows["last"] - SPEC.burn_in
    rows["new_observations"] = rows["new_steps"] + 1
    for name in ("observation", "reward"):
        rows[name] *= 0.0
    sender.send_rows(rows)
    drain(server)
    sample = server.sample(16)
    assert sample.rows is not None
    assert sample.drawn_steps == server.stats()["drawn_steps"] == (sample.rows["last"] - SPEC.burn_in).sum() < 16 * 4


def test_every_draw_has_its_own_random_numbers(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 100)
    draws = []
    for _ in range(5):
        rows = server.sample(8).rows
        assert rows is not None
        draws.append(tuple(rows["serial"].tolist()))
    assert len(set(draws)) == 5
