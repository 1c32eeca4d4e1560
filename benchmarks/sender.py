"""A simulated actor: it sends entries of windows and hears which are committed."""

import time

from benchmarks.harness import random_rows
from rmc.common.bus.protocol import Bus, EntryId
from rmc.common.window import WindowSpec
from rmc.common.wire import MAX_ENTRY_BYTES, encode_hello, encode_windows

CHUNK = 16  # windows an entry, fewer of large ones


class Sender:
    """Actor 0; each entry is encoded anew, as an actor does."""

    def __init__(self, bus: Bus, spec: WindowSpec) -> None:
        self.bus, self.spec, self.chunk = bus, spec, min(CHUNK, max(1, MAX_ENTRY_BYTES // spec.dtype.itemsize))
        self._rows = random_rows(spec, self.chunk)
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
