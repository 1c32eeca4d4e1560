"""A run goes on counting though its ring is gone."""

import os
from pathlib import Path

import msgpack
import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Ack, EntryId, ReplayOwner
from rmc.common.replay import ObservationStatistics
from rmc.deploy.redis.progress_backup import ProgressBackup
from rmc.deploy.run.folder import RunFolder
from rmc.replay_server.commit_record import Progress
from tests.replay_server.support import SPEC

COUNTED, FIRST, SECOND, NEWER = (
    Progress(ObservationStatistics.none(SPEC), env_steps=steps).publish() for steps in (7, 1, 2, 9)
)
WHOLE = msgpack.packb({"replay": COUNTED})
OTHERS = ([1], {"replay": 5}, {"replay": {}}, {"another": b"x"}, {None: b"x"})
DAMAGED = {
    "two bits": WHOLE[:30] + bytes([WHOLE[30] ^ 0x40]) + WHOLE[31:-9] + bytes([WHOLE[-9] ^ 1]) + WHOLE[-8:],
    "empty": b"", "cut": WHOLE[:-3], "zeros": bytes(len(WHOLE)), "doubled": WHOLE * 2, "no msgpack": b"\xc1",
    **{str(other): msgpack.packb(other) for other in OTHERS},
}  # fmt: skip


def commit(bus: MemoryBus, role: str, progress: bytes) -> None:
    bus.commit(ReplayOwner(role, bus.take_epoch(role)), {0: Ack(EntryId(1, 0), 0)}, progress)


def test_what_was_published_is_said_again_where_nothing_is(tmp_path: Path) -> None:
    counters, before = ProgressBackup(RunFolder(tmp_path), shards=2), MemoryBus()
    commit(before, "replay-0", FIRST)
    commit(before, "replay-1", SECOND)
    counters.keep(before)
    after = MemoryBus()
    commit(after, "replay-1", NEWER)
    ProgressBackup(RunFolder(tmp_path), shards=2).restore(after)
    assert (after.progress("replay-0"), after.progress("replay-1")) == (FIRST, NEWER)


def test_what_a_server_that_is_away_had_counted_stays(tmp_path: Path) -> None:
    counters, before, after = ProgressBackup(RunFolder(tmp_path), shards=2), MemoryBus(), MemoryBus()
    commit(before, "replay-0", FIRST)
    commit(before, "replay-1", SECOND)
    counters.keep(before)
    commit(after, "replay-0", NEWER)  # Redis came back empty, and the other one's node is lost
    counters.keep(after, at_once=True)
    counters.restore(again := MemoryBus())
    assert (again.progress("replay-0"), again.progress("replay-1")) == (NEWER, SECOND)


def test_an_empty_redis_does_not_take_the_copy_away(tmp_path: Path) -> None:
    counters, bus = ProgressBackup(RunFolder(tmp_path), shards=1), MemoryBus()
    counters.restore(bus)
    assert bus.progress("replay") is None
    commit(bus, "replay", COUNTED)
    counters.keep(bus)
    counters.keep(MemoryBus(), at_once=True)
    counters.restore(again := MemoryBus())
    assert again.progress("replay") == COUNTED


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_copy_is_told_and_the_run_goes_on(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "replay-counters").write_bytes(content)
    counters, bus = ProgressBackup(RunFolder(tmp_path), shards=1), MemoryBus()
    counters.restore(bus)
    assert bus.progress("replay") is None
    assert [record.getMessage().count("replay-counters: cannot be read") for record in caplog.records] == [1]
    commit(bus, "replay", NEWER)
    counters.keep(bus)
    counters.restore(again := MemoryBus())
    assert again.progress("replay") == NEWER
    assert len(caplog.records) == 1


def test_a_damaged_value_in_redis_is_not_copied_over_a_whole_one(tmp_path: Path) -> None:
    counters, bus = ProgressBackup(RunFolder(tmp_path), shards=1), MemoryBus()
    commit(bus, "replay", COUNTED)
    counters.keep(bus)
    commit(bus, "replay", NEWER[:-1] + b"x")
    counters.keep(bus, at_once=True)
    counters.restore(again := MemoryBus())
    assert again.progress("replay") == COUNTED


def test_a_copy_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a power cut leaves an empty one. Who writes does so; only what the disk is told is watched."""
    synchronised, fsync = [], os.fsync

    def watched(handle: int) -> None:
        fsync(handle)
        content = Path(f"/proc/self/fd/{handle}").read_bytes()
        synchronised.append((content, (tmp_path / "replay-counters").exists()))

    monkeypatch.setattr(os, "fsync", watched)
    counters, bus = ProgressBackup(RunFolder(tmp_path), shards=1), MemoryBus()
    commit(bus, "replay", COUNTED)
    counters.keep(bus)
    assert synchronised == [(WHOLE, False)]
    assert (tmp_path / "replay-counters").read_bytes() == WHOLE
