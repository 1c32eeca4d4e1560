"""What a run's replay servers have counted, kept in its folder: with it a run goes on though its ring is lost."""

import logging
import time
from contextlib import suppress

import msgpack

from rmc.common.bus.protocol import Bus
from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.shard import Shard
from rmc.common.whole_file import write_whole
from rmc.deploy.run.folder import COUNTERS, RunFolder
from rmc.replay_server.commit_record import crc_matches

KEEP_SECONDS = 10.0
log = logging.getLogger(__name__)


class ProgressBackup:
    """Copies of what the replay servers publish with every commit."""

    def __init__(self, folder: RunFolder, shards: int) -> None:
        self._path = folder.path / COUNTERS
        self._roles = [Shard(index, shards).role for index in range(shards)]
        self._kept, self._keep_at = self._read(), 0.0

    def keep(self, bus: Bus, at_once: bool = False) -> None:
        """Copy them, once in a while."""
        if not at_once and time.monotonic() < self._keep_at:
            return
        self._keep_at = time.monotonic() + KEEP_SECONDS
        with suppress(BusUnavailable, BusFull, OSError):  # the disk is full: those before stay
            progress = {role: raw for role in self._roles if (raw := bus.progress(role)) is not None}
            if progress and all(map(crc_matches, progress.values())):
                self._kept |= progress  # what a replay server that is away had counted stays
                write_whole(self._path, msgpack.packb(self._kept))

    def restore(self, bus: Bus) -> None:
        """Restore the counters in Redis where it has none; a replay server with an older ring goes on from them."""
        for role, raw in self._kept.items():
            bus.set_progress(role, raw)

    def _read(self) -> dict[str, bytes]:
        """By role. A damaged file is told, and does not keep the run from going on: most often the ring has them."""
        try:
            progress = msgpack.unpackb(self._path.read_bytes())
            if not isinstance(progress, dict) or not all(
                role in self._roles and isinstance(raw, bytes) and crc_matches(raw) for role, raw in progress.items()
            ):
                raise ValueError("damaged, or no counters of this run's replay servers")
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            log.warning("%s: cannot be read (%s); going on without what it counted", self._path, error)
            return {}
        return progress
