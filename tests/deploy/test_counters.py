"""A run goes on counting though its ring is gone."""

from pathlib import Path

from common.bus import Ack, EntryId, Holder, MemoryBus
from deploy.counters import Counters
from deploy.run_folder import RunFolder


def commit(bus: MemoryBus, role: str, progress: bytes) -> None:
    bus.commit(Holder(role, bus.take_epoch(role)), {0: Ack(EntryId(1, 0), 0)}, progress)


def test_what_was_published_is_said_again_where_nothing_is(tmp_path: Path) -> None:
    counters, before = Counters(RunFolder(tmp_path), shards=2), MemoryBus()
    commit(before, "replay-0", b"first")
    commit(before, "replay-1", b"second")
    counters.keep(before)
    after = MemoryBus()
    commit(after, "replay-1", b"newer")
    Counters(RunFolder(tmp_path), shards=2).restore(after)
    assert (after.progress("replay-0"), after.progress("replay-1")) == (b"first", b"newer")


def test_an_empty_redis_does_not_take_the_copy_away(tmp_path: Path) -> None:
    counters, bus = Counters(RunFolder(tmp_path), shards=1), MemoryBus()
    counters.restore(bus)
    assert bus.progress("replay") is None
    commit(bus, "replay", b"counted")
    counters.keep(bus)
    counters.keep(MemoryBus(), at_once=True)
    counters.restore(again := MemoryBus())
    assert again.progress("replay") == b"counted"
