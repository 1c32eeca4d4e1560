"""What a run's replay servers have counted, kept in its folder: with it a run goes on though its ring is lost."""

import time
from contextlib import suppress

import msgpack

from common.bus import Bus
from common.errors import BusUnavailable
from common.replay import Shard
from deploy.run_folder import RunFolder

KEEP_SECONDS = 10.0


class Counters:
    """Copies of what the replay servers publish with every commit."""

    def __init__(self, folder: RunFolder, shards: int) -> None:
        self._path = folder.path / "replay-counters"
        self._roles = [Shard(index, shards).role for index in range(shards)]
        self._keep_at = 0.0

    def keep(self, bus: Bus, at_once: bool = False) -> None:
        """Copy them, once in a while."""
        if not at_once and time.monotonic() < self._keep_at:
            return
        self._keep_at = time.monotonic() + KEEP_SECONDS
        with suppress(BusUnavailable, OSError):  # the disk is full: those before stay
            found = {role: raw for role in self._roles if (raw := bus.progress(role)) is not None}
            if found:
                temporary = self._path.with_suffix(".new")
                temporary.write_bytes(msgpack.packb(found))
                temporary.rename(self._path)

    def restore(self, bus: Bus) -> None:
        """Say them where Redis has nothing; a replay server whose ring is older then goes on from them."""
        if self._path.exists():
            for role, raw in msgpack.unpackb(self._path.read_bytes()).items():
                bus.set_progress(role, raw)
