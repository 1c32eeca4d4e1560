"""A replay server in the place of another: counters and acks go on, of ring or Redis whatever is left, fencing."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Bus, EntryId
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import ConfigError, FencedError
from rmc.common.replay import SampleStatus
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.recovery import valid_leaves
from tests.replay_server.support import SPEC, Make, Sender, close, drain, filled, make_rows, stored


def test_an_empty_ring_goes_on_amid_a_life(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(folder="lost"), bus, 2)
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
    server, sender = filled(make(config, folder="lost", actors=1, on=bus), bus, 12)
    for _ in range(4):
        assert server.sample(2).status is SampleStatus.BATCH
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
    assert server.owner.epoch == 2
    server.update_priorities(np.array([3]), np.array([5.0], np.float32))
    assert server.stats()["evicted_priorities"] == before["evicted_priorities"] + 1

    drain(server)
    assert sender.granted() == 52 + 20 + 16  # a warm-up and the slack beyond what was in
    sender.send(4)
    drain(server)
    assert server.sample(2).status is SampleStatus.WAIT  # 16 of 20 steps
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
    server, sender = filled(make(), bus, 4)
    published = bus.progress("replay")
    assert published is not None
    sender.send(2)
    drain(server)
    close(server)
    bus._progress["replay"] = published
    assert stored(make())["reward"][:, 0].tolist() == list(range(6))


def test_draws_after_what_was_published_stay(make: Make, bus: MemoryBus) -> None:
    server, _ = filled(make(), bus, 4)
    server.sample(4)
    close(server)
    assert make().stats()["drawn_steps"] == 4 * SPEC.train


@pytest.mark.parametrize("published", [b"x", b"\0" * 200, b"\xff" * 128])
def test_published_counters_that_make_no_sense_are_passed_over(make: Make, bus: MemoryBus, published: bytes) -> None:
    bus.set_progress("replay", published)
    assert make().stats()["env_steps"] == 0


@pytest.mark.parametrize("place", [0, 60, 115])
def test_published_counters_with_two_bits_flipped_are_passed_over(
    make: Make, bus: MemoryBus, place: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever they count then: serials of terabytes, epochs that no later one passes."""
    filled(make(folder="lost"), bus, 4)
    published = bytearray(bus.progress("replay") or b"")
    published[place] ^= 0x40
    published[place + 4] ^= 0x01
    (other := MemoryBus()).set_progress("replay", bytes(published))
    again = make(folder="empty", on=other)
    assert (again.stats()["env_steps"], again.stats()["windows"], again.owner.epoch) == (0, 0, 1)
    assert "published are damaged" in caplog.text


def test_lost_redis_data_neither_doubles_nor_goes_back(make: Make, bus: MemoryBus) -> None:
    server, sender = filled(make(), bus, 4)
    close(server)
    empty = MemoryBus()
    server = make(on=empty)
    assert server.owner.epoch == 2  # above the one in the ring, though this bus has never seen a replay server
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
    assert new.owner.epoch == 5
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
        progress = bus._progress[role] if len(looks) > 1 else published
        drain(old) if len(looks) == 1 else None  # which knows of no newer server yet
        return progress

    monkeypatch.setattr(bus, "progress", progress)
    new = make(folder="new")
    drain(new)
    assert new.owner.epoch == 5
    assert new.stats()["windows"] == 5
    with pytest.raises(FencedError):
        old.bus.commit(old.owner, {}, old._store.ring.progress.publish())


def test_a_power_cut_loses_the_end_of_a_ring_alone(
    make: Make, bus: MemoryBus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server, sender = filled(make(actors=1), bus, 50)
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
    assert [record.getMessage() for record in caplog.records if "torn" in record.message] == [
        "replay ring: 3 windows were damaged or torn by a crash; they are never drawn"
    ]
    sample = server.sample(64)
    assert sample.rows is not None
    assert sample.rows["serial"].max() < 50
    server.update_priorities(np.array([51]), np.array([9.0], np.float32))  # as drawn before the cut
    assert server.stats()["evicted_priorities"] == 1
    sender.send(2)
    drain(server)
    assert server._store.ring.holds(np.arange(48, 56)).tolist() == [True] * 2 + [False] * 3 + [True] * 2 + [False]


def test_draws_that_a_power_cut_has_lost_count(make: Make, bus: MemoryBus, tmp_path: Path) -> None:
    """Though nothing came in after them."""
    server, _ = filled(make(actors=1), bus, 50)
    shutil.copytree(tmp_path / "replay", tmp_path / "on disk")
    server.sample(4)
    server._credit._republish_at = 0.0
    server.step()
    after = make(folder="on disk", actors=1).stats()
    assert (after["draws"], after["drawn_steps"]) == (1, 4 * SPEC.train)


def test_a_ring_of_which_nothing_is_left_begins_empty(make: Make, bus: MemoryBus) -> None:
    config = ReplayConfig(capacity=100, replay_ratio=2.0, warmup_steps=20)
    server, sender = filled(make(config, actors=1), bus, 12)
    server._store.ring.rows["serial"] = -1
    close(server)
    server = make(config, actors=1)
    drain(server)
    assert (server.stats()["windows"], server.stats()["ring_fill"]) == (12, 0)
    assert sender.granted() == 48 + 20 + 16  # or everyone would wait for the other
    assert server.sample(2).status is SampleStatus.WAIT


def test_a_ring_that_is_ahead_of_another_that_came_after_it_goes(make: Make, bus: MemoryBus) -> None:
    old, one, other = make(folder="old"), Sender(bus), Sender(bus, 1)
    for sender in (one, other):
        sender.send(2)
    drain(old)
    one.send(9)
    taken = old._reader.read(old._store.ring.progress.streams)
    assert taken is not None
    old._insert(taken)  # and stands still before it publishes that
    new = make(folder="new")
    bus._streams[0].clear()
    other.send(1)
    drain(new)
    close(old)
    close(new)
    again = make(folder="old")
    assert again._store.tree.total == 0.0  # so that a warm-up is collected once more
    drain(again)
    ack = bus.ack(1)
    assert ack is not None
    assert ack.id == EntryId(1, 2)
    assert again.stats()["windows"] == 5


def test_one_server_a_folder(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmc.common.process.file_lock.LOCK_SECONDS", 0.2)
    make()
    with pytest.raises(ConfigError, match="another replay server holds this folder"):
        make()
