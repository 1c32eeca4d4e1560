"""``MemoryBus``: the bus in this process's memory, for lockstep runs and tests."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from rmc.common.bus.protocol import (
    MAX_EPOCH_GAP,
    METRICS_KEPT,
    Ack,
    Entry,
    EntryId,
    ReplayOwner,
    Version,
    actor_role,
)
from rmc.common.errors import BusUnavailable, FencedError


class MemoryBus:
    """The bus of a lockstep run: same promises, one process, no threads."""

    def __init__(self) -> None:
        self._epochs: dict[str, int] = {}
        self._streams: dict[int, dict[EntryId, bytes]] = {}
        self._last_ids: dict[int, EntryId] = {}
        self._acks: dict[int, Ack] = {}
        self._replay: dict[str, str] = {}
        self._progress: dict[str, bytes] = {}
        self._weights: dict[bool, tuple[Version, bytes]] = {}
        self._records: dict[str, list[dict[str, Any]]] = {}
        self._forgotten: Counter[str] = Counter()  # records that made room
        self._stop: str | None = None
        self.refused: Counter[str] = Counter()  # here, nobody writes what cannot be read
        self.dead_letters: list[tuple[Entry, str]] = []

    def take_epoch(self, role: str, floor: int = 0) -> int:
        held = self._epochs.get(role, 0)
        self._epochs[role] = (held if floor <= held < floor + MAX_EPOCH_GAP else floor) + 1
        return self._epochs[role]

    def current_epoch(self, role: str) -> int:
        return self._epochs.get(role, 0)

    def append(self, actor: int, entry_id: EntryId, payload: bytes) -> None:
        last = self._last_ids.get(actor, EntryId(0, -1))
        if entry_id.seq == 0:
            self._epochs[actor_role(actor)] = max(self.current_epoch(actor_role(actor)), entry_id.epoch)
        if entry_id <= last:
            if last.epoch > min(self.current_epoch(actor_role(actor)), entry_id.epoch + MAX_EPOCH_GAP):
                raise BusUnavailable(f"actor {actor}: there is an entry of epoch {last.epoch}, which nobody has taken")
            if last.epoch > entry_id.epoch:
                raise FencedError(f"actor {actor}: epoch {last.epoch} has replaced epoch {entry_id.epoch}")
            return
        if entry_id.seq > 0 and actor not in self._streams:
            raise BusUnavailable(f"the stream of actor {actor} is gone")
        self._last_ids[actor] = entry_id
        self._streams.setdefault(actor, {})[entry_id] = payload

    def actors(self) -> list[int]:
        return sorted(self._streams)

    def read(self, after: Mapping[int, EntryId], count: int) -> list[Entry]:
        entries: list[Entry] = []
        for actor, cursor in after.items():
            stream = self._streams.get(actor, {})
            entries += [Entry(actor, key, stream[key]) for key in stream if key > cursor][:count]
        return entries

    def commit(self, owner: ReplayOwner, acks: Mapping[int, Ack], progress: bytes = b"") -> None:
        self._check_replay(owner)
        if progress:
            self._progress[owner.role] = progress
        self._epochs[owner.role] = owner.epoch
        for actor, ack in acks.items():
            self._acks[actor] = ack
            stream = self._streams.get(actor, {})
            for key in [key for key in stream if key <= ack.id]:
                del stream[key]

    def progress(self, role: str) -> bytes | None:
        return self._progress.get(role)

    def set_progress(self, role: str, progress: bytes) -> None:
        self._progress.setdefault(role, progress)

    def _check_replay(self, owner: ReplayOwner) -> None:
        newest = self.current_epoch(owner.role)
        if newest > owner.epoch:
            raise FencedError(f"{owner.role} epoch {owner.epoch} was replaced by {newest}")

    def drop_stream(self, owner: ReplayOwner, actor: int) -> None:
        self._check_replay(owner)
        self._streams.pop(actor, None)
        self._last_ids.pop(actor, None)

    def ack(self, actor: int) -> Ack | None:
        return self._acks.get(actor)

    def dead_letter(self, entry: Entry, reason: str) -> None:
        self.dead_letters.append((entry, reason))

    def announce_replay(self, owner: ReplayOwner, address: str) -> None:
        self._replay[owner.role] = address

    def replay_address(self, role: str) -> str | None:
        return self._replay.get(role)

    def publish_weights(self, version: Version, blob: bytes, evaluate: bool = False) -> None:
        if version.epoch < self.current_epoch("learner"):
            raise FencedError(f"learner epoch {version.epoch} was replaced")
        self._weights[evaluate] = (version, blob)

    def latest_version(self, evaluate: bool = False) -> Version | None:
        return self._weights[evaluate][0] if evaluate in self._weights else None

    def weights(self, evaluate: bool = False) -> tuple[Version, bytes] | None:
        return self._weights.get(evaluate)

    def emit(self, role: str, record: Mapping[str, Any]) -> None:
        kept = self._records.setdefault(role, [])
        kept.append({**record, "role": role})
        if len(kept) >= 2 * METRICS_KEPT:
            del kept[:METRICS_KEPT]
            self._forgotten[role] += METRICS_KEPT

    def records(self, after: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, str]]:
        records: list[dict[str, Any]] = []
        cursors = {}
        for role, cursor in after.items():
            kept, forgotten = self._records.get(role, []), self._forgotten[role]
            records += kept[max(0, int(cursor) - forgotten) :]
            cursors[role] = str(forgotten + len(kept))
        return records, cursors

    def records_end(self, roles: Iterable[str]) -> dict[str, str]:
        return {role: str(self._forgotten[role] + len(self._records.get(role, []))) for role in roles}

    def memory_bytes(self) -> int:
        return 0

    def request_stop(self, reason: str) -> None:
        self._stop = reason

    def stop_requested(self) -> str | None:
        return self._stop
