"""kill -9 of a real replay process amid inserts, draws and priorities; and folders that were damaged."""

import random
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import ConfigError
from rmc.common.replay import SampleStatus
from rmc.learner.replay.client import ReplayClient
from rmc.replay_server.recovery import ReplayStore, open_store, valid_leaves, warn_of_torn_rows
from rmc.replay_server.sum_tree import SumTree
from tests.holding import held_for_a_moment
from tests.replay_server.replay_child import ACTORS, SECRET
from tests.replay_server.support import SPEC, Sender, make_rows
from tests.waiting import wait_until

CAPACITY = 30_000
CHUNK = 16
KILLS = 10  # more under load: tests/faults/kill_replay.py


def opened(folder: Path, capacity: int = CAPACITY) -> closing[ReplayStore]:
    return closing(open_store(folder, SPEC, capacity, 0.6))


def start(url: str, run: str, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tests.replay_server.replay_child", url, run, str(folder), str(CAPACITY)]
    return subprocess.Popen(command, cwd=Path(__file__).parents[2])


def acknowledged(bus: RedisBus) -> list[int]:
    """Windows of each actor that an ack covers."""
    acks = [bus.ack(actor) for actor in range(ACTORS)]
    return [ack.id.seq * CHUNK if ack is not None else 0 for ack in acks]


def check(store: ReplayStore, acked: list[int], sent: list[int]) -> None:
    """All that was acknowledged, but for what was evicted since, is there once, whole and in order."""
    progress = store.ring.progress
    serials = np.arange(progress.valid_from, progress.next_serial)
    rows = store.ring.rows[serials % CAPACITY]
    assert np.array_equal(rows["serial"], serials)
    assert progress.env_steps == progress.next_serial * SPEC.train
    inserted = [progress.streams[actor].id.seq * CHUNK for actor in range(ACTORS)]
    assert sum(inserted) == progress.next_serial
    for actor in range(ACTORS):
        assert acked[actor] <= inserted[actor] <= sent[actor]
        own = rows[rows["actor"] == actor]
        marks = own["reward"][:, 0].astype(int)
        assert np.array_equal(marks, np.arange(inserted[actor] - len(own), inserted[actor]))
        assert np.array_equal((own["seq"] - 1) * CHUNK + own["k"], marks)
        if len(own):
            expected = make_rows(len(own), marks[0])
            assert np.array_equal(own["observation"], expected["observation"])
    rebuilt = SumTree(CAPACITY)
    leaves = np.zeros(CAPACITY)
    leaves[serials % CAPACITY] = store.priorities[serials % CAPACITY].astype(float) ** 0.6
    rebuilt.rebuild(leaves)
    assert np.array_equal(store.tree._nodes, rebuilt._nodes)
    assert np.isclose(rebuilt.total, leaves.sum())


def draw_until(client: ReplayClient, end: float, rng: np.random.Generator) -> int:
    """Draw and give priorities back, as a learner does, until a moment; how many batches came."""
    draws = 0
    while time.monotonic() < end:
        sample = client.sample(32)
        if sample.rows is None:
            time.sleep(0.001)
            continue
        draws += sample.status is SampleStatus.BATCH
        client.update_priorities(sample.rows["serial"].copy(), rng.exponential(size=32).astype(np.float32))
    return draws


@pytest.mark.long  # tests/faults/test_short.py kills it at every commit point
def test_killed_again_and_again_amid_inserts(redis_url: str, run_name: str, tmp_path: Path) -> None:
    bus, rng, chance = RedisBus(redis_url, run_name), np.random.default_rng(0), random.Random(0)
    senders = [Sender(bus, actor) for actor in range(ACTORS)]
    client = ReplayClient(lambda: f"unix:{tmp_path}/r.sock", SECRET, SPEC, 32)
    draws = amid = 0
    for _ in range(KILLS):
        child = start(redis_url, run_name, tmp_path)
        try:
            for sender in senders:
                for _ in range(chance.randrange(200, 300)):
                    sender.send(CHUNK)
            before = acknowledged(bus)
            wait_until(lambda before=before: acknowledged(bus) != before)
            draws += draw_until(client, time.monotonic() + chance.uniform(0.0, 0.03), rng)
            for _ in range(chance.randrange(40)):  # where one core serves both, it may be through with the others
                senders[0].send(CHUNK)
        finally:
            child.kill()
            child.wait()
        acked, sent = acknowledged(bus), [sender.marks for sender in senders]
        amid += acked != sent
        with opened(tmp_path / "replay") as store:
            check(store, acked, sent)
    client.close()
    assert draws > 0
    assert amid > KILLS / 2, "most kills came after all was taken in"
    finish(bus, redis_url, run_name, tmp_path, senders)


def finish(bus: RedisBus, url: str, run: str, folder: Path, senders: list[Sender]) -> None:
    """A last life that is ended cleanly: everything ever sent has been taken in once."""
    sent = [sender.marks for sender in senders]
    assert sum(sent) > 2 * CAPACITY  # the ring went round
    bus.redis.delete(bus.key("replay"))  # a server that can be ended says it again
    child = start(url, run, folder)
    try:
        wait_until(lambda: acknowledged(bus) == sent)
        wait_until(lambda: bus.replay_address("replay") is not None)
        child.terminate()
        assert child.wait(10) == 0
    finally:
        child.kill()
        child.wait()
    with opened(folder / "replay") as store:
        check(store, sent, sent)
        assert store.ring.progress.next_serial == sum(sent)
        assert store.ring.progress.windows == CAPACITY
        assert store.ring.progress.replay_epoch == KILLS + 1
    assert not (folder / "r.sock").exists()


def test_rows_torn_by_a_power_cut_hold_no_window(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with opened(tmp_path, 10) as store:
        store.set_priorities(store.ring.write(make_rows(14)), np.full(10, 2.0, np.float32))
        store.ring.progress.max_priority = 2.0
        store.ring.commit(14)
        store.ring.rows["serial"][[5, 7]] = 0
    with opened(tmp_path, 10) as store:
        assert (store.ring.progress.valid_from, store.ring.progress.next_serial) == (4, 14)
        assert np.flatnonzero(valid_leaves(store)).tolist() == [0, 1, 2, 3, 4, 6, 8, 9]
        assert store.ring.holds(np.array([3, 4, 5, 7, 13, 14])).tolist() == [False, True, False, False, True, False]
        assert store.tree.total == pytest.approx(8 * 2.0**0.6)
        warn_of_torn_rows(store)
    assert "2 windows were damaged or torn by a crash; they are never drawn" in caplog.text


NAN = b"\xff" * 4


@pytest.mark.parametrize("damage", ["gone", "short", "garbage", "zeros"])
def test_damaged_priorities_only_cost_their_values(tmp_path: Path, damage: str) -> None:
    with opened(tmp_path, 10) as store:
        store.set_priorities(store.ring.write(make_rows(6)), np.full(6, 0.25, np.float32))
        store.ring.progress.max_priority = 3.0
        store.ring.commit(6)
    path = tmp_path / "priorities"
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"short": NAN * 2, "garbage": NAN * 10, "zeros": bytes(40)}[damage])
    with opened(tmp_path, 10) as store:
        assert store.priorities.tolist() == [3.0] * 10
        assert store.tree.total == pytest.approx(6 * 3.0**0.6)


def test_a_killed_creation_is_begun_again(tmp_path: Path) -> None:
    (tmp_path / "ring.tmp").write_bytes(b"half")
    with opened(tmp_path, 10) as store:
        assert store.ring.progress.windows == 0


def test_a_server_that_is_about_to_end_is_waited_for(tmp_path: Path) -> None:
    with held_for_a_moment(tmp_path / "lock"), opened(tmp_path, 10) as store:
        assert store.ring.progress.windows == 0


def test_a_refused_folder_is_unlocked(tmp_path: Path) -> None:
    with opened(tmp_path, 10):
        pass
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"--capacity=11"), opened(tmp_path, 11):
            pass
    with opened(tmp_path, 10):
        pass
