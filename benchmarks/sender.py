"""A simulated actor: it sends entries of windows and hears which are committed."""

import time

from benchmarks.harness import random_rows
from rmc.common.bus.protocol import Bus, EntryId, actor_role
from rmc.common.window import WindowSpec
from rmc.common.wire import MAX_ENTRY_BYTES, encode_hello, encode_windows

CHUNK = 16  # windows an entry, fewer of large ones


class Sender:
    """An actor; each entry is encoded anew, as by a real one, unless a recorded one is given."""

    def __init__(self, bus: Bus, spec: WindowSpec, actor: int = 0) -> None:
        self.bus, self.spec, self.chunk = bus, spec, min(CHUNK, max(1, MAX_ENTRY_BYTES // spec.dtype.itemsize))
        self._rows, self._actor = random_rows(spec, self.chunk), actor
        self._epoch, self.seq, self._acknowledged = bus.take_epoch(actor_role(actor)), 0, 0
        self.bus.append(actor, EntryId(self._epoch, 0), encode_hello(spec))

    def send(self, payload: bytes | None = None) -> None:
        """One entry."""
        self.seq += 1
        payload = encode_windows(self._rows, self.spec) if payload is None else payload
        self.bus.append(self._actor, EntryId(self._epoch, self.seq), payload)

    def wait(self, behind: int = 0) -> None:
        """Until all but so many entries are committed."""
        while self._acknowledged < self.seq - behind:
            ack = self.bus.ack(self._actor)
            if ack is not None and ack.id.epoch == self._epoch:
                self._acknowledged = ack.id.seq
            if self._acknowledged < self.seq - behind:
                time.sleep(0.0005)
