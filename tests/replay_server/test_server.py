"""The replay server without its socket: intake, credit, draws, statistics, restarts, fencing."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from common.bus import Bus, EntryId, MemoryBus, Version
from common.errors import BusUnavailable, ConfigError, FencedError
from common.redis_bus import RedisBus
from common.replay import Draw
from common.wire import encode_windows
from replay_server.observation_sums import observation_sums
from replay_server.recovery import valid_leaves
from replay_server.server import ReplayConfig, ReplayServer
from tests.learner.rows import observation_valid
from tests.replay_server.support import SPEC, Sender, make_rows

Make = Callable[..., ReplayServer]
OPEN = ReplayConfig(capacity=100, replay_ratio=1e6, warmup_steps=0)  # the limiter never holds anything back


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus()


@pytest.fixture
def make(tmp_path: Path, bus: MemoryBus) -> Iterator[Make]:
    """Servers in one folder unless another is named, closed at the end."""
    made: list[ReplayServer] = []

    def build(config: ReplayConfig = OPEN, folder: str = "replay", actors: int = 2, total: int = 10**6,
              slack: int = 16, seed: int = 7, on: Bus | None = None) -> ReplayServer:  # fmt: skip
        made.append(ReplayServer(SPEC, config, tmp_path / folder, seed, total, actors, slack, on or bus))
        return made[-1]

    yield build
    for server in made:
        server._store.lock >= 0 and close(server)


def close(server: ReplayServer) -> None:
    """Close once, however often it is called."""
    if server._store.lock >= 0:
        server.close()
        server._store.lock = -1


def drain(server: ReplayServer) -> None:
    while server.step():
        pass


def stored(server: ReplayServer) -> np.ndarray:
    """All windows that may be sampled, by serial."""
    progress = server._store.ring.progress
    serials = np.arange(progress.valid_from, progress.next_serial)
    rows = server._store.ring.rows[serials % server.config.capacity]
    assert rows["serial"].tolist() == serials.tolist()
    return rows


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
    server, sender = make(), Sender(bus)
    sender.send(2)
    drain(server)
    server.update_priorities(np.array([0, 1]), np.array([0.5, 6.0], np.float32))
    rows = make_rows(3)
    rows["initial_priority"] = [0, 2, 0]
    sender.send_rows(rows)
    drain(server)
    assert server._store.priorities[:5].tolist() == [0.5, 6.0, 6.0, 2.0, 6.0]


def test_values_are_what_windows_are_drawn_by(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    sender.send(20)
    drain(server)
    priorities = np.random.default_rng(0).exponential(size=20).astype(np.float32)
    server.update_priorities(np.arange(20), priorities)
    sample = server.sample(64)
    assert sample.rows is not None
    scaled = priorities.astype(float) ** 0.6
    np.testing.assert_allclose(sample.values, scaled[sample.rows["serial"]])
    assert sample.mass == pytest.approx(scaled.sum())
    assert (sample.windows, sample.drawn_steps) == (20, 64 * SPEC.train)


def test_exponent_zero_is_uniform(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=100, replay_ratio=1e6, warmup_steps=0, priority_exponent=0.0)
    server, sender = make(config), Sender(bus)
    sender.send(50)
    drain(server)
    server.update_priorities(np.arange(50), np.linspace(1e-6, 1e6, 50).astype(np.float32))
    counts = np.zeros(50)
    for _ in range(40):
        sample = server.sample(50)
        assert sample.rows is not None
        assert (sample.values == 1).all()
        counts += np.bincount(sample.rows["serial"], minlength=50)
    assert (counts == 40).all()  # 50 strata over 50 equal windows


def test_statistics_against_a_loop_and_padding_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    rows = make_rows(200)
    rows["first"] = rng.choice([0, SPEC.burn_in], 200)
    rows["last"] = rng.integers(SPEC.burn_in + 1, SPEC.steps + 1, 200)
    rows["new_steps"] = rng.integers(0, rows["last"] - SPEC.burn_in + 1)
    rows["new_observations"] = rows["new_steps"] + rng.integers(0, 2, 200)
    rows["blank"] = rng.random(rows["blank"].shape) < 0.4
    expected = [
        row["observation"][t].astype(float)
        for row in rows
        for t in range(row["last"] - row["new_observations"] + 1, row["last"] + 1)
        if not row["blank"][t]
    ]
    sums = observation_sums(rows, SPEC)
    assert sums.count == len(expected)
    np.testing.assert_allclose(sums.total, np.sum(expected, axis=0), rtol=1e-9)
    np.testing.assert_allclose(sums.total_square, np.sum(np.square(expected), axis=0), rtol=1e-9)
    rows["observation"][~observation_valid(rows, SPEC)] = np.nan
    rows["observation"][rows["blank"] == 1] = 1e30
    again = observation_sums(rows, SPEC)
    assert again.count == sums.count
    assert np.array_equal(again.total, sums.total)
    assert np.array_equal(again.total_square, sums.total_square)


def test_statistics_survive_a_restart_and_count_once(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    sender.send(8)
    drain(server)
    expected = observation_sums(make_rows(8), SPEC)
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
                assert sample.values is not None
                drawn.append(sample.rows.tobytes() + sample.values.tobytes())
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
    server, sender = make(), Sender(bus)
    sender.send(50)
    drain(server)
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
    assert server.sample(4).draw is Draw.WAIT
    assert (server.stats()["learner_waiting_for"], server.waiting_for()) == ("warm-up", "windows")
    senders[0].send(5)
    drain(server)
    assert [sender.granted() for sender in senders] == [20 + 18, 18]
    senders[1].send(9)
    drain(server)
    assert [sender.granted() for sender in senders] == [20, 36]  # 56 of 56 are in
    assert server.waiting_for() == "draws"
    draws = 0
    while server.sample(4).draw is Draw.BATCH:
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
    while server.sample(64).draw is Draw.BATCH:
        published.add(sender.granted())
        draws += 1
        server.step()
    assert draws > 300
    assert len(published) < 10
    assert sender.granted() < draws * 256 // 100 + 800
    server.step()
    assert sender.granted() == draws * 256 // 100 + 800


def test_the_end_is_announced_and_reached(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=1000, replay_ratio=2.0, warmup_steps=8)
    server, sender = make(config, actors=1, total=400, slack=16), Sender(bus)
    sender.send(2)
    drain(server)
    ack = bus.ack(0)
    assert ack is not None
    assert not ack.final
    sent, outcomes = 2, []
    while (draw := server.sample(4).draw) is not Draw.FINISHED:
        outcomes.append(draw)
        if draw is Draw.WAIT:
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
    assert owed <= outcomes.count(Draw.BATCH) <= owed + tolerance
    assert server.stats()["replay_ratio"] == outcomes.count(Draw.BATCH) * 16 / (400 - 8)


def test_an_empty_ring_makes_the_learner_wait(make: Make) -> None:
    assert make().sample(4).draw is Draw.WAIT


def test_a_new_life_counts_from_zero(make: Make, bus: MemoryBus) -> None:
    server, sender = make(ReplayConfig(capacity=100, replay_ratio=1.0, warmup_steps=100)), Sender(bus)
    sender.send(5)
    drain(server)
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
    bad = [b"", b"\x00" * 50, good[:-1], good[:-1] + b"\xff", encode_windows(nan, SPEC), b"\xc1" * (2 << 20)]
    for payload in bad:
        sender.send_raw(payload)
        sender.send(1)
    drain(server)
    stats = server.stats()
    assert stats["dead_letters"] == len(bad) == bus._redis.xlen(f"rmc:{run_name}:dead")
    assert stats["dead_letters_crc"] == 1
    assert stats["dead_letters_window"] == 1
    assert stats["dead_letters_too-large"] == 1
    assert stats["env_steps"] == 6 * SPEC.train
    assert stored(server)["reward"][:, 0].tolist() == list(range(6))
    lost = 3 * 3 * SPEC.train  # what the sender counts in the three that were whole in size, at least
    assert sender.granted() >= lost + stats["env_steps"] + 116 - stats["env_steps"]
    assert bus.ack(0) is not None
    assert bus._redis.xlen(f"rmc:{run_name}:windows:0") == 0  # trimmed


@pytest.mark.parametrize("kind", ["memory", "redis"])
def test_what_a_stream_lacks_is_sent_again(make: Make, kind: str, redis_url: str, run_name: str) -> None:
    bus: Bus = MemoryBus() if kind == "memory" else RedisBus(redis_url, run_name)
    server, sender = make(on=bus), Sender(bus)
    sender.send(2)
    drain(server)
    sender.seq += 1  # entry 2 is what Redis lost
    sender.send_rows(make_rows(1, 3))
    drain(server)
    assert server.stats()["entry_gaps"] == 1
    assert len(stored(server)) == 2
    assert bus.ack(0) is not None
    with pytest.raises(BusUnavailable, match="gone"):
        sender.send(1)
    sender.greet()
    sender.seq = 1
    for mark in (2, 3):
        sender.send_rows(make_rows(1, mark))
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 2, 3]
    assert server.stats()["entry_gaps"] == 1
    assert sender.granted() > 0


@pytest.mark.parametrize("bad", [EntryId(2**64 - 1, 2**64 - 1), EntryId(1, 2**63), EntryId(2**31, 0)])
@pytest.mark.parametrize("kind", ["memory", "redis"])
def test_an_id_past_all_others_closes_a_stream_to_nobody(
    make: Make, kind: str, bad: EntryId, redis_url: str, run_name: str
) -> None:
    bus: Bus = MemoryBus() if kind == "memory" else RedisBus(redis_url, run_name)
    server, sender = make(on=bus), Sender(bus)
    sender.send(2)
    drain(server)
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
    server, sender = make(), Sender(bus)
    sender.send(2)
    drain(server)
    for _ in range(2):  # what it keeps starts at entry 6, also when it was asked to send again
        sender.greet()
        sender.seq = 5
        sender.send_rows(make_rows(1, 5))
        drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [0, 1, 5]
    assert server.stats()["entry_gaps"] == 2


def test_an_empty_ring_goes_on_amid_a_life(make: Make, bus: MemoryBus) -> None:
    server, sender = make(folder="lost"), Sender(bus)
    sender.send(2)
    drain(server)
    sender.send(3)
    bus._progress.clear()  # nobody knows how far the lost one was
    server = make(folder="empty")
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == [2, 3, 4]
    assert server.stats()["entry_gaps"] == 1


@pytest.mark.parametrize("kind", ["memory", "redis"])
def test_a_lost_ring_takes_no_counter_back(make: Make, kind: str, redis_url: str, run_name: str) -> None:
    bus: Bus = MemoryBus() if kind == "memory" else RedisBus(redis_url, run_name)
    config = ReplayConfig(capacity=100, replay_ratio=2.0, warmup_steps=20)
    server, sender = make(config, folder="lost", actors=1, on=bus), Sender(bus)
    sender.send(12)
    drain(server)
    for _ in range(4):
        assert server.sample(2).draw is Draw.BATCH
    server.update_priorities(np.array([3]), np.array([9.0], np.float32))
    sender.send(1)
    drain(server)  # the commit publishes what was drawn before it
    before, statistics = server.stats(), server.statistics()
    assert before["env_steps"] == 52
    assert before["drawn_steps"] == 32

    server = make(config, folder="empty", actors=1, on=bus)
    after = server.stats()
    for name in ("env_steps", "drawn_steps", "draws", "windows", "max_priority"):
        assert after[name] == before[name], name
    assert after["ring_fill"] == 0
    assert after["entry_gaps"] == 0
    np.testing.assert_array_equal(server.statistics().total, statistics.total)
    assert server.statistics().count == statistics.count
    assert server.holder.epoch == 2
    server.update_priorities(np.array([3]), np.array([5.0], np.float32))
    assert server.stats()["evicted_priorities"] == before["evicted_priorities"] + 1

    drain(server)
    assert sender.granted() == 52 + 20 + 16  # a warm-up and the slack beyond what was in
    sender.send(4)
    drain(server)
    assert server.sample(2).draw is Draw.WAIT  # 16 of 20 steps
    sender.send(1)
    drain(server)
    sample = server.sample(2)
    assert sample.rows is not None
    assert sample.env_steps == 72
    assert set(sample.rows["reward"][:, 0].tolist()) <= {13, 14, 15, 16, 17}
    assert stored(server)["serial"].tolist() == [13, 14, 15, 16, 17]
    close(server)
    again = make(config, folder="empty", actors=1, on=bus)  # and that survives a restart of its own
    assert again.stats()["env_steps"] == 72
    assert len(stored(again)) == 5


def test_a_ring_that_is_ahead_of_what_was_published_stays(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    sender.send(4)
    drain(server)
    published = bus.progress("replay")
    assert published is not None
    sender.send(2)
    drain(server)
    close(server)
    bus._progress["replay"] = published
    assert stored(make())["reward"][:, 0].tolist() == list(range(6))


@pytest.mark.parametrize("published", [b"x", b"\0" * 200, b"\xff" * 128])
def test_published_counters_that_make_no_sense_are_passed_over(make: Make, bus: MemoryBus, published: bytes) -> None:
    bus.set_progress("replay", published)
    assert make().stats()["env_steps"] == 0


def test_lost_redis_data_neither_doubles_nor_goes_back(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    sender.send(4)
    drain(server)
    close(server)
    empty = MemoryBus()
    server = make(on=empty)
    assert server.holder.epoch == 2  # above the one in the ring, though this bus has never seen a replay server
    sender.bus, sender.seq = empty, 0
    sender.greet()
    sender.send_rows(make_rows(4))  # seq 1 again: the ack was lost with the data, so the actor sends it again
    sender.send_rows(make_rows(2, 4))
    drain(server)
    assert stored(server)["reward"][:, 0].tolist() == list(range(6))
    assert server.stats()["entry_gaps"] == 0


@pytest.mark.parametrize("kind", ["memory", "redis"])
def test_a_newer_server_fences_the_older_before_it_trims(make: Make, kind: str, redis_url: str, run_name: str) -> None:
    bus: Bus = MemoryBus() if kind == "memory" else RedisBus(redis_url, run_name)
    old, sender = make(folder="old", on=bus), Sender(bus)
    old.step()
    new = make(folder="new", on=bus)
    sender.send(3)
    with pytest.raises(FencedError, match="replay epoch 1 was replaced by 2"):
        old.step()
    drain(new)
    assert stored(new)["reward"][:, 0].tolist() == [0, 1, 2]


def test_what_the_older_server_commits_at_the_last_moment_counts(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, sender = make(folder="old"), Sender(bus)
    sender.send(3)
    drain(old)
    sender.send(2)
    take_epoch = bus.take_epoch

    def take_after_a_commit(role: str, floor: int = 0) -> int:
        drain(old)
        return take_epoch(role, floor)

    monkeypatch.setattr(bus, "take_epoch", take_after_a_commit)
    new = make(folder="new")
    drain(new)
    assert new.stats()["windows"] == old.stats()["windows"] == 5
    ack = bus.ack(0)
    assert ack is not None
    assert ack.id == EntryId(1, 2)


def test_what_was_published_in_another_redis_is_older_than_the_next_server(make: Make, bus: MemoryBus) -> None:
    for _ in range(3):
        old = make(folder="old")
        close(old)
    Sender(bus).send(3)
    old = make(folder="old")
    drain(old)
    published = bus.progress("replay")
    assert published is not None
    empty = MemoryBus()
    empty.set_progress("replay", published)
    new = make(folder="new", on=empty)
    assert new.holder.epoch == 5
    assert new.stats()["windows"] == 3


def test_what_another_redis_held_is_read_once_the_older_server_is_fenced(
    make: Make, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(3):
        close(make(folder="old"))
    old, sender = make(folder="old"), Sender(bus)
    sender.send(3)
    drain(old)
    published = bus.progress("replay")
    assert published is not None
    sender.send(2)
    bus._epochs.pop("replay")  # Redis is empty but for what the launcher has brought back
    looks = []

    def progress(role: str) -> bytes | None:
        looks.append(role)
        found = bus._progress[role] if len(looks) > 1 else published
        drain(old) if len(looks) == 1 else None  # which knows of no newer server yet
        return found

    monkeypatch.setattr(bus, "progress", progress)
    new = make(folder="new")
    drain(new)
    assert new.holder.epoch == 5
    assert new.stats()["windows"] == 5
    with pytest.raises(FencedError):
        old.bus.commit(old.holder, old._acks())


def test_a_power_cut_loses_the_end_of_a_ring_alone(make: Make, bus: MemoryBus, tmp_path: Path) -> None:
    server, sender = make(actors=1), Sender(bus)
    sender.send(50)
    drain(server)
    server.sample(4)
    shutil.copytree(tmp_path / "replay", tmp_path / "on disk")
    sender.send(3)
    drain(server)
    before = server.stats()
    server = make(folder="on disk", actors=1)
    after = server.stats()
    for name in ("env_steps", "windows", "draws", "drawn_steps"):
        assert after[name] == before[name], name
    assert np.count_nonzero(valid_leaves(server._store)) == 50
    sample = server.sample(64)
    assert sample.rows is not None
    assert sample.rows["serial"].max() < 50
    server.update_priorities(np.array([51]), np.array([9.0], np.float32))  # as drawn before the cut
    assert server.stats()["evicted_priorities"] == 1
    sender.send(2)
    drain(server)
    assert server._store.ring.holds(np.arange(48, 56)).tolist() == [True] * 2 + [False] * 3 + [True] * 2 + [False]


def test_a_ring_of_which_nothing_is_left_begins_empty(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=100, replay_ratio=2.0, warmup_steps=20)
    server, sender = make(config, actors=1), Sender(bus)
    sender.send(12)
    drain(server)
    server._store.ring.rows["serial"] = -1
    close(server)
    server = make(config, actors=1)
    drain(server)
    assert (server.stats()["windows"], server.stats()["ring_fill"]) == (12, 0)
    assert sender.granted() == 48 + 20 + 16  # or everyone would wait for the other
    assert server.sample(2).draw is Draw.WAIT


def test_a_ring_that_is_ahead_of_another_that_came_after_it_goes(make: Make, bus: MemoryBus) -> None:
    old, one, other = make(folder="old"), Sender(bus), Sender(bus, 1)
    for sender in (one, other):
        sender.send(2)
    drain(old)
    one.send(9)
    taken = old._intake.read(old._store.ring.progress.streams)
    assert taken is not None
    old._insert(taken)  # and stands still before it publishes that
    new = make(folder="new")
    bus._streams[0].clear()
    other.send(1)
    drain(new)
    close(old)
    close(new)
    again = make(folder="old")
    drain(again)
    ack = bus.ack(1)
    assert ack is not None
    assert ack.id == EntryId(1, 2)
    assert again.stats()["windows"] == 5


def test_one_server_a_folder(make: Make) -> None:
    make()
    with pytest.raises(ConfigError, match="another replay server holds this folder"):
        make()


def test_policy_lag_is_measured(make: Make, bus: MemoryBus) -> None:
    server, sender = make(), Sender(bus)
    bus.publish_weights(Version(1, 50), b"")
    rows = make_rows(2)
    rows["weights_update"] = [20, 40]
    sender.send_rows(rows)
    drain(server)
    metrics = server.metrics()
    assert metrics["policy_lag_mean"] == 20
    assert metrics["policy_lag_max"] == 30
    assert metrics["windows"] == 2


@pytest.mark.parametrize(
    ("option", "value"),
    [("capacity", 0), ("replay_ratio", 0.0), ("replay_ratio", float("nan")), ("warmup_steps", -1),
     ("priority_exponent", -0.1)],
)  # fmt: skip
def test_nonsense_options_are_named(option: str, value: float) -> None:
    with pytest.raises(ConfigError, match=option.replace("_", "-")):
        ReplayConfig(**{option: value})  # type: ignore[arg-type]
