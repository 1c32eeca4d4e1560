"""A simulated actor: it sends entries of windows and hears which are committed."""

import time

from benchmarks.harness import random_rows
from rmc.common.bus.protocol import EntryId
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.window import WindowSpec
from rmc.common.wire import encode_hello, encode_windows

CHUNK = 16  # windows an entry


class Sender:
    """Actor 0; each entry is encoded anew, as an actor does."""

    def __init__(self, bus: RedisBus, spec: WindowSpec) -> None:
        self.bus, self.spec, self._rows = bus, spec, random_rows(spec, CHUNK)
        self._epoch, self.seq, self._acknowledged = bus.take_epoch("actor-0"), 0, 0
        self.bus.append(0, EntryId(self._epoch, 0), encode_hello(spec))

    def send(self) -> None:
        """One entry."""
        self.seq += 1
        self.bus.append(0, EntryId(self._epoch, self.seq), encode_windows(self._rows, self.spec))

    def wait(self, behind: int = 0) -> None:
        """Until all but so many entries are committed."""
        while self._acknowledged < self.seq - behind:
            ack = self.bus.ack(0)
            if ack is not None and ack.id.epoch == self._epoch:
                self._acknowledged = ack.id.seq
            if self._acknowledged < self.seq - behind:
                time.sleep(0.0005)
