"""Reads the actors' streams: a bounded batch of entries, checked, stamped with their origin, as one array of rows."""

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rmc.common.bus.protocol import MAX_EPOCH_GAP, Bus, Entry, EntryId, actor_role
from rmc.common.errors import BusFull, MessageError
from rmc.common.shard import Shard
from rmc.common.window import Rows, WindowSpec, joined
from rmc.common.wire import decode_rows, max_entry_bytes
from rmc.replay_server.commit_record import StreamPosition
from rmc.replay_server.row_check import FAULTS, row_faults

ROUND_BYTES = 4 << 20  # read at most about this much in a round, so that the learner is served in between
MAX_ENTRIES = 256  # of one actor in a round
DISCOVERY_ROUNDS = 100  # rounds between looks for actors beyond those the run was started with
BEFORE_ALL = EntryId(0, -1)
LARGEST = EntryId(2**31 - 1, 2**40)  # of each number; a row can say no larger epoch, and no incarnation sends more
SKIPPED = 1 << 20  # entries of an incarnation that Redis can have lost at once
MOST_ASKED = 3  # times that an actor sends the same again, until what is missing counts as lost


@dataclass(frozen=True)
class IngestBatch:
    """What one read gave."""

    rows: Rows  # (n,) writable, all but the serial as it will stand in the ring
    positions: dict[int, StreamPosition]  # of the streams read from, after this round
    broken: dict[int, EntryId]  # actors whose stream lacks an entry, and the one before: nothing past it was taken


class StreamReader:
    """Reads every actor's stream past where the ring is. Refused entries go to the dead letters, counted."""

    def __init__(self, spec: WindowSpec, bus: Bus, actors: int, shard: Shard) -> None:
        self.spec, self.bus, self._shard = spec, bus, shard
        self.refused: Counter[str] = Counter()  # dead letters by reason
        self.gaps = 0  # places where an entry's number does not follow its predecessor's
        self._gaps_after: dict[int, EntryId] = {}  # past which entry an actor's last one was found
        self._resends: dict[int, tuple[EntryId, int]] = {}  # past which entry an actor was asked again, how often
        self._actors = {actor for actor in range(actors) if shard.owns(actor)}
        self._rounds = 0
        self._entry_bytes = ROUND_BYTES  # the largest entry of the last round that had any

    def read(self, positions: Mapping[int, StreamPosition]) -> IngestBatch | None:
        """The next entries of all streams, or None where there are none."""
        if self._rounds % DISCOVERY_ROUNDS == 0:
            self._actors.update(filter(self._shard.owns, self.bus.actors()), positions)
        self._rounds += 1
        entries = self.bus.read(self._cursors(positions), self._count())
        if not entries:
            return None
        self._entry_bytes = max(len(entry.payload) for entry in entries) + 64
        return self._round(entries, dict(positions))

    def sends_again(self, actor: int, before: EntryId) -> None:
        """An actor's stream was dropped, so that it sends again what came after that entry."""
        asked, times = self._resends.get(actor, (before, 0))
        self._resends[actor] = before, times * (asked == before) + 1

    def _cursors(self, positions: Mapping[int, StreamPosition]) -> dict[int, EntryId]:
        return {actor: positions[actor].id if actor in positions else BEFORE_ALL for actor in self._actors}

    def _count(self) -> int:
        """Entries of each stream."""
        return min(max(ROUND_BYTES // (self._entry_bytes * len(self._actors)), 1), MAX_ENTRIES)

    def _round(self, entries: list[Entry], positions: dict[int, StreamPosition]) -> IngestBatch:
        entries, broken = self._in_order(entries, positions)
        bodies = [self._decode(entry) for entry in entries]
        rows = self._stamped(entries, bodies)
        faults = row_faults(rows, self.spec)
        if faults.any():
            bodies = self._without_faults(entries, bodies, faults)
            rows = self._stamped(entries, bodies)
        for entry, body in zip(entries, bodies, strict=True):
            before = positions.get(entry.actor, StreamPosition(BEFORE_ALL, 0))
            settled = before.settled_steps if entry.id.epoch == before.id.epoch else 0  # an actor's new incarnation
            settled += self._lost_steps(entry) if body is None else int(body["new_steps"].sum())
            positions[entry.actor] = StreamPosition(entry.id, settled)
        return IngestBatch(rows, positions, broken)

    def _in_order(
        self, entries: list[Entry], positions: Mapping[int, StreamPosition]
    ) -> tuple[list[Entry], dict[int, EntryId]]:
        """Entries up to the first gap of each stream that can be filled, and of those with one what was before it."""
        last = {actor: position.id for actor, position in positions.items()}
        newest = {entry.actor: entry.id.epoch for entry in entries}
        taken_epochs = {
            actor: self.bus.current_epoch(actor_role(actor))
            for actor, epoch in newest.items()
            if epoch > last.get(actor, BEFORE_ALL).epoch
        }
        accepted: list[Entry] = []
        broken: dict[int, EntryId] = {}
        for entry in entries:
            before = last.get(entry.actor, BEFORE_ALL)
            if entry.actor in broken:
                continue
            if not _is_possible(entry.id, before, taken_epochs.get(entry.actor, 0)):
                self._refuse(
                    entry, MessageError("id", f"{entry.id.epoch}-{entry.id.seq}, which no incarnation can have reached")
                )
                broken[entry.actor] = before
                continue
            if self._lacks_entries(before, entry):
                broken[entry.actor] = before
                continue
            last[entry.actor] = entry.id
            accepted.append(entry)
        return accepted, broken

    def _lacks_entries(self, before: EntryId, entry: Entry) -> bool:
        """Whether Redis has lost what comes between, and its actor may still have it.

        It has not where it was asked often: Redis may have lost again what came. Nor where the ring does not know this
        incarnation at all: what is missing then was trimmed after another ring's commit.
        """
        same_epoch = entry.id.epoch == before.epoch
        if entry.id.seq == (before.seq + 1 if same_epoch else 0):
            return False
        if self._gaps_after.get(entry.actor) != before:  # else it is still open
            self._gaps_after[entry.actor] = before
            self.gaps += 1
        asked, times = self._resends.get(entry.actor, (before, 0))
        return same_epoch and (asked != before or times < MOST_ASKED)

    def _decode(self, entry: Entry) -> Rows | None:
        try:
            return decode_rows(entry.payload, self.spec)
        except MessageError as error:
            self._refuse(entry, error)
            return None

    def _without_faults(
        self, entries: list[Entry], bodies: list[Rows | None], faults: NDArray[np.uint8]
    ) -> list[Rows | None]:
        """The bodies, but for those with a faulty row, which are refused."""
        ends = np.cumsum([0 if body is None else len(body) for body in bodies])
        kept = list(bodies)
        for index, of_body in enumerate(np.split(faults, ends[:-1])):
            if of_body.any():
                self._refuse(entries[index], MessageError("window", FAULTS[of_body[of_body > 0][0]]))
                kept[index] = None
        return kept

    def _refuse(self, entry: Entry, error: MessageError) -> None:
        with suppress(BusFull):  # no room for it; the round that frees some must not wait for that
            self.bus.dead_letter(entry, str(error))
        self.refused[error.reason] += 1

    def _stamped(self, entries: list[Entry], bodies: list[Rows | None]) -> Rows:
        """All bodies as one array; the origin comes from the entry ids, whatever the sender wrote."""
        parts = [(entry, body) for entry, body in zip(entries, bodies, strict=True) if body is not None and len(body)]
        rows = joined([body for _, body in parts], self.spec)
        counts = [len(body) for _, body in parts]
        starts = np.cumsum([0, *counts[:-1]]) if counts else np.zeros(0, np.int64)
        rows["actor"] = np.repeat([entry.actor for entry, _ in parts], counts)
        rows["epoch"] = np.repeat([entry.id.epoch for entry, _ in parts], counts)
        rows["seq"] = np.repeat([entry.id.seq for entry, _ in parts], counts)
        rows["k"] = np.arange(len(rows)) - np.repeat(starts, counts)
        return rows

    def _lost_steps(self, entry: Entry) -> int:
        """At most how many steps a refused entry carried: its actor counts them, so they must not eat its credit."""
        size = min(len(entry.payload), max_entry_bytes(self.spec))
        return size // self.spec.dtype.itemsize * self.spec.train


def _is_possible(new: EntryId, before: EntryId, newest_epoch: int) -> bool:
    """Whether an id can have been reached, where ``before`` was taken last and its actor has taken so many epochs."""
    if new.epoch == before.epoch:
        return new.seq <= min(before.seq + SKIPPED, LARGEST.seq)
    return new.epoch <= min(newest_epoch, before.epoch + MAX_EPOCH_GAP, LARGEST.epoch) and new.seq <= LARGEST.seq
