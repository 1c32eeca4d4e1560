"""The bus over Redis: unix socket, TCP or TLS; the keys stand in ``common/bus/protocol.py``."""

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

from rmc.common.bus.metrics_record import decode_record, encode_record
from rmc.common.bus.protocol import (
    MAX_EPOCH_GAP,
    METRICS_KEPT,
    Ack,
    Entry,
    EntryId,
    ReplayOwner,
    actor_role,
)
from rmc.common.bus.weight_store import WeightStore
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, FencedError, MessageError

DEAD_LETTERS_KEPT = 1_000
RECORDS_READ = 1_000  # of a role at a time
DEAD_LETTER_BYTES = 1_024
ACTOR_DIGITS = 4  # an actor's id is below 4096; what else stands among them is no actor
TRIM_SCRIPT = """
if tonumber(redis.call('GET', KEYS[1]) or '0') > tonumber(ARGV[1]) then return -1 end
for i = 2, #KEYS do redis.call('XTRIM', KEYS[i], 'MINID', ARGV[i]) end
return 0
"""
DROP_SCRIPT = """
if tonumber(redis.call('GET', KEYS[1]) or '0') > tonumber(ARGV[1]) then return -1 end
redis.call('DEL', KEYS[2])
return 0
"""


class RedisBus(WeightStore):
    """All roles of one run over one Redis. Not thread-safe: one per thread."""

    def expire(self, seconds: int | None) -> None:
        """Let all that this run has in Redis vanish after so many seconds; None takes that back."""
        pattern = re.sub(r"([*?\[\]\\])", r"\\\1", self.prefix) + ":*"
        pieces, named = self.piece_keys()
        for key in self.call(lambda: list(self.redis.scan_iter(match=pattern, count=1000))):
            if seconds is not None:
                self.call(self.redis.expire, key, seconds)
            elif not key.startswith(pieces) or key in named:  # of other versions, pieces go anyhow
                self.call(self.redis.persist, key)

    def set_config(self, config: bytes) -> None:
        self.call(lambda: self.redis.set(self.key("config"), config))

    def config(self) -> bytes | None:
        raw: bytes | None = self.call(lambda: self.redis.get(self.key("config")))
        return raw

    def take_epoch(self, role: str, floor: int = 0) -> int:
        key = self.key("epoch", role)
        while not floor < (epoch := self._next_epoch(key, floor)) <= floor + MAX_EPOCH_GAP:
            # Redis lost its data, or somebody changed them; two incarnations that catch up at once still get one each.
            self.call(self.redis.incrby, key, floor - epoch)
        return epoch

    def _next_epoch(self, key: str, floor: int) -> int:
        try:
            return int(self.call(lambda: self.redis.incr(key)))
        except ConfigError as error:
            if not re.search("not an integer|overflow", str(error)):
                raise
            self.call(lambda: self.redis.set(key, floor))
            return floor

    def check_room(self, role: str) -> None:
        with suppress(ConfigError):  # no number: who takes an epoch next fixes it, or says so
            self.call(lambda: self.redis.incrby(self.key("epoch", role), 0))  # a write that changes nothing

    def current_epoch(self, role: str) -> int:
        return self.number(self.call(lambda: self.redis.get(self.key("epoch", role))))

    def append(self, actor: int, entry_id: EntryId, payload: bytes) -> None:
        stream = self.key("windows", actor)
        try:
            self.call(lambda: self._add_entry(actor, stream, entry_id, payload))
        except ConfigError as error:
            if not re.search("equal or smaller|exhausted the last possible ID", str(error)):
                raise
            self._check_not_fenced(actor, stream, entry_id)

    def _add_entry(self, actor: int, stream: str, entry_id: EntryId, payload: bytes) -> None:
        if entry_id.seq == 0:
            if self.number(self.redis.get(epoch := self.key("epoch", actor_role(actor)))) < entry_id.epoch:
                self.redis.set(epoch, entry_id.epoch)
            self.redis.sadd(self.key("actors"), actor)
        stored = self.redis.xadd(
            stream, {"p": payload}, id=f"{entry_id.epoch}-{entry_id.seq}", nomkstream=entry_id.seq > 0
        )
        if stored is None:
            raise _gone(stream)

    def _check_not_fenced(self, actor: int, stream: str, entry_id: EntryId) -> None:
        """A refused id is ours, stored by a retried call, unless a larger epoch that was taken wrote since."""
        try:
            last = _entry_id(self.call(lambda: self.redis.xinfo_stream(stream))["last-generated-id"])
        except ConfigError as error:
            if "no such key" not in str(error):
                raise
            raise _gone(stream) from None  # it was dropped after it had refused the id
        if last.epoch == entry_id.epoch:
            return
        if last.epoch > min(self.current_epoch(actor_role(actor)), entry_id.epoch + MAX_EPOCH_GAP):
            raise BusUnavailable(f"{stream} has an entry of epoch {last.epoch}, which nobody has taken")
        raise FencedError(f"actor {actor}: epoch {last.epoch} has replaced epoch {entry_id.epoch}")

    def actors(self) -> list[int]:
        members = self.call(lambda: self.redis.smembers(self.key("actors")))
        return sorted(int(actor) for actor in members if actor.isdigit() and len(actor) <= ACTOR_DIGITS)

    def read(self, after: Mapping[int, EntryId], count: int) -> list[Entry]:
        if not after:
            return []
        return _entries(self.call(lambda: self.redis.xread(self._cursors(after), count=count)))

    def _cursors(self, after: Mapping[int, EntryId]) -> dict[str, str]:
        return {self.key("windows", actor): f"{cursor.epoch}-{max(cursor.seq, 0)}" for actor, cursor in after.items()}

    def commit(self, owner: ReplayOwner, acks: Mapping[int, Ack], progress: bytes = b"") -> None:
        if not acks:
            return
        try:
            self._commit(owner, acks, progress)
        except BusFull:  # a full Redis has no room for the acks either, and only trimming makes some
            self._trim(owner, acks)
            self._commit(owner, acks, progress)

    def _trim(self, owner: ReplayOwner, acks: Mapping[int, Ack]) -> None:
        """Trim alone: a full Redis has no room for the acks, but for this."""
        self._run(TRIM_SCRIPT, owner, list(acks), [f"{ack.id.epoch}-{ack.id.seq + 1}" for ack in acks.values()])

    def _run(self, script: str, owner: ReplayOwner, actors: list[int], words: list[str]) -> None:
        """A script on actors' streams: a full Redis 7.0 refuses all in a MULTI; by themselves commands are not fenced.

        Raises FencedError where a newer replay server has come.
        """
        keys = [self.key("epoch", owner.role), *(self.key("windows", actor) for actor in actors)]
        if self.call(lambda: self.redis.eval(script, len(keys), *keys, str(owner.epoch), *words)) < 0:
            raise FencedError(f"{owner.role} epoch {owner.epoch} was replaced")

    def _commit(self, owner: ReplayOwner, acks: Mapping[int, Ack], progress: bytes) -> None:
        key = self.key("epoch", owner.role)

        def transaction(pipe: Any) -> None:
            held = self._held(pipe, owner)
            pipe.multi()
            for actor, ack in acks.items():
                pipe.xtrim(self.key("windows", actor), minid=f"{ack.id.epoch}-{ack.id.seq + 1}", approximate=False)
            if held < owner.epoch:  # Redis lost its data
                pipe.set(key, owner.epoch)
            if progress:
                pipe.hset(self.key("progress"), owner.role, progress)
            pipe.hset(
                self.key("acks"),
                mapping={
                    actor: f"{ack.id.epoch} {ack.id.seq} {ack.granted_steps} {int(ack.final)}"
                    for actor, ack in acks.items()
                },
            )

        self.call(lambda: self.redis.transaction(transaction, key))

    def progress(self, role: str) -> bytes | None:
        raw: bytes | None = self.call(lambda: self.redis.hget(self.key("progress"), role))
        return raw

    def set_progress(self, role: str, progress: bytes) -> None:
        self.call(lambda: self.redis.hsetnx(self.key("progress"), role, progress))

    def _held(self, pipe: Any, owner: ReplayOwner) -> int:
        """The newest epoch of this replay server that Redis knows. Raises FencedError where it is newer than ours."""
        held = self.number(pipe.get(self.key("epoch", owner.role)))
        if held > owner.epoch:
            raise FencedError(f"{owner.role} epoch {owner.epoch} was replaced by {held}")
        return held

    def drop_stream(self, owner: ReplayOwner, actor: int) -> None:
        self._run(DROP_SCRIPT, owner, [actor], [])

    def ack(self, actor: int) -> Ack | None:
        raw = self.call(lambda: self.redis.hget(self.key("acks"), str(actor)))
        numbers = self.integers(raw, 4)
        return Ack(EntryId(numbers[0], numbers[1]), numbers[2], bool(numbers[3])) if numbers else None

    def dead_letter(self, entry: Entry, reason: str) -> None:
        fields = {
            "actor": entry.actor,
            "id": f"{entry.id.epoch}-{entry.id.seq}",
            "reason": reason,
            "head": entry.payload[:DEAD_LETTER_BYTES],
        }
        self.call(lambda: self.redis.xadd(self.key("dead"), fields, maxlen=DEAD_LETTERS_KEPT))

    def announce_replay(self, owner: ReplayOwner, address: str) -> None:
        self.call(lambda: self.redis.hset(self.key("replay"), owner.role, address))

    def replay_address(self, role: str) -> str | None:
        raw = self.call(lambda: self.redis.hget(self.key("replay"), role))
        return raw.decode(errors="replace") if raw else None

    def emit(self, role: str, record: Mapping[str, Any]) -> None:
        key, fields = self.key("metrics", role), {"r": encode_record(record)}
        self.call(lambda: self.redis.xadd(key, fields, maxlen=METRICS_KEPT))

    def records(self, after: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, str]]:
        cursors: dict[str, str] = dict(after)
        records: list[dict[str, Any]] = []
        if not after:
            return records, cursors
        streams = {self.key("metrics", role): cursor for role, cursor in after.items()}
        reply = self.call(lambda: self.redis.xread(streams, count=RECORDS_READ))
        for name, entries in reply:
            role = name.decode().removeprefix(f"{self.key('metrics')}:")
            cursors[role] = entries[-1][0].decode()
            records += [{**record, "role": role} for record in map(self._record, entries) if record is not None]
            if len(entries) == RECORDS_READ:  # more than roles say: whoever does that shall not fill Redis
                self.call(self.redis.xtrim, name, METRICS_KEPT)
        return records, cursors

    def records_end(self, roles: Iterable[str]) -> dict[str, str]:
        asked = list(roles)
        replies = self.each("XREVRANGE", [self.key("metrics", role) for role in asked], "+", "-", "COUNT", 1)
        return {role: last[0][0].decode() if last else "0" for role, last in zip(asked, replies, strict=True)}

    def _record(self, entry: tuple[bytes, dict[bytes, bytes]]) -> dict[str, Any] | None:
        try:
            return decode_record(entry[1].get(b"r", b""))
        except MessageError as error:
            self.refused[error.reason] += 1
            return None

    def memory_bytes(self) -> int:
        try:
            return int(self.call(self.redis.memory_stats)["total.allocated"])
        except ConfigError:  # in a Redis of the user's own, whom it does not let ask
            return 0

    def request_stop(self, reason: str) -> None:
        self.call(lambda: self.redis.set(self.key("stop"), reason))

    def stop_requested(self) -> str | None:
        raw: bytes | None = self.call(lambda: self.redis.get(self.key("stop")))
        return raw.decode(errors="replace") if raw is not None else None

    def clear_stop(self) -> None:
        self.call(lambda: self.redis.delete(self.key("stop")))


def _gone(stream: str) -> BusUnavailable:
    return BusUnavailable(f"{stream} is gone: Redis has lost its data")


def _entry_id(raw: bytes | str) -> EntryId:
    text = raw.decode() if isinstance(raw, bytes) else raw
    epoch, seq = text.split("-")
    return EntryId(int(epoch), int(seq))


def _entries(reply: Any) -> list[Entry]:
    return [
        Entry(int(name.rsplit(b":", 1)[1]), _entry_id(raw_id), fields.get(b"p", b""))
        for name, entries in reply
        for raw_id, fields in entries
    ]
