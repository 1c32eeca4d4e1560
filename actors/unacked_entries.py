"""What an actor has sent and must keep: entries in order until the replay server has committed them."""

from collections import deque
from typing import NamedTuple

from rmc.common.bus.protocol import Ack, Bus, EntryId
from rmc.common.errors import BusUnavailable
from rmc.common.window import Rows, WindowSpec
from rmc.common.wire import MAX_ENTRY_BYTES, encode_hello, encode_windows


class _Kept(NamedTuple):
    id: EntryId
    payload: bytes
    steps: int  # new agent steps in it


class UnackedEntries:
    """The stream of one actor in one epoch.

    An entry is put in first and sent then, so that a failed ``send`` loses nothing: the next one goes on,
    and after a lost connection it starts again at the hello and the oldest entry kept, because a Redis that
    came back may have forgotten them. Explicit ids make repeats harmless.
    """

    def __init__(self, bus: Bus, actor: int, epoch: int, spec: WindowSpec, resends: int) -> None:
        """``resends`` are those of the epochs before."""
        self._bus, self._actor, self._spec = bus, actor, spec
        self.epoch, self.bytes, self.resends = epoch, 0, resends
        self.committed_steps = 0  # agent steps that acknowledged entries carried
        self._hello = encode_hello(spec)
        self._kept: deque[_Kept] = deque()
        self._sent = 0  # entries at the front of ``_kept`` that were sent
        self._greeted = False
        self._next_seq = 1
        self._max_rows = max(1, MAX_ENTRY_BYTES // spec.dtype.itemsize)

    def __len__(self) -> int:
        return len(self._kept)

    def put(self, rows: Rows) -> None:
        """Make entries of (n,) rows; gives each its origin (actor, epoch, seq, k)."""
        for start in range(0, len(rows), self._max_rows):
            part = rows[start : start + self._max_rows]
            part["actor"], part["epoch"], part["seq"] = self._actor, self.epoch, self._next_seq
            part["k"] = range(len(part))
            payload = encode_windows(part, self._spec)
            steps = int(part["new_steps"].sum())
            self._kept.append(_Kept(EntryId(self.epoch, self._next_seq), payload, steps))
            self.bytes += len(payload)
            self._next_seq += 1

    def send(self) -> bool:
        """Append what was not sent yet; whether there was anything. Raises BusUnavailable, BusFull, FencedError."""
        sent_any = False
        try:
            if not self._greeted:
                self._bus.append(self._actor, EntryId(self.epoch, 0), self._hello)
                self._greeted = sent_any = True
            while self._sent < len(self._kept):
                entry = self._kept[self._sent]
                self._bus.append(self._actor, entry.id, entry.payload)
                self._sent += 1
                sent_any = True
        except BusUnavailable:
            self.send_again()
            raise
        return sent_any

    def send_again(self) -> None:
        """Let the next ``send`` start at the oldest entry kept."""
        self.resends += self._sent
        self._sent, self._greeted = 0, False

    def acknowledge(self, ack: Ack) -> bool:
        """Forget what is committed; whether it was anything, or nothing is left."""
        before = len(self._kept)
        while self._kept and self._kept[0].id <= ack.id:
            entry = self._kept.popleft()
            self.bytes -= len(entry.payload)
            self.committed_steps += entry.steps
            self._sent = max(0, self._sent - 1)
        return len(self._kept) < before or not self._kept
