"""The bus over Redis: unix socket, TCP or TLS; the keys stand in ``common/bus/protocol.py``."""

import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import redis
from redis.backoff import ExponentialBackoff
from redis.retry import Retry

from rmc.common.bus.metrics_record import decode_record, encode_record
from rmc.common.bus.protocol import (
    LIVES,
    METRICS_KEPT,
    Ack,
    Entry,
    EntryId,
    ReplayAddress,
    ReplayOwner,
    Version,
    actor_role,
    join_pieces,
    split_pieces,
)
from rmc.common.bus.redis_client import RedisClient, refusal
from rmc.common.bus.redis_url import HIDDEN, fault, shown
from rmc.common.checksum import crc32
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, FencedError, MessageError

TIMEOUT_SECONDS = 3.0  # that Redis may take for an answer; two of them are less than a learner waits for a batch
TIMEOUTS, TIMEOUT_LIMIT = ("socket_timeout", "socket_connect_timeout"), 1e6  # that a URL may name; seconds
DEAD_LETTERS_KEPT = 1_000
INTEGER = re.compile(rb"-?[0-9]{1,18}")
KINDS = ("weights", "evaluate")  # of policies: what acts, and what is evaluated
PIECES = 4096  # of a policy, at most: 1 GiB
UNPUBLISHED_SECONDS = 300  # that a piece is kept whose version has not become the newest: far more than all take
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
T = TypeVar("T")


class RedisBus:
    """All roles of one run over one Redis. Not thread-safe: one per thread.

    Redis's own retries are short (a lost reply is repeated, which explicit ids make harmless);
    an outage longer than that raises BusUnavailable and the role's loop waits.
    """

    def __init__(self, url: str, run: str) -> None:
        """``url``: ``unix:///path``, ``redis://host:port`` or ``rediss://…``. Raises ConfigError."""
        lost = (redis.exceptions.ConnectionError,)  # one that hangs would keep the role once more
        retry = Retry(ExponentialBackoff(cap=0.1, base=0.01), retries=3, supported_errors=lost)
        if fix := fault(url):
            raise ConfigError("--redis-url", shown(url), fix)
        try:
            self._redis: Any = RedisClient.from_url(  # Any: its annotations do not know decode_responses
                url, retry=retry, socket_timeout=TIMEOUT_SECONDS
            )
            pool = self._redis.connection_pool
            pool.connection_class(**pool.connection_kwargs)  # knows what may stand behind the question mark
            if not all(0 < pool.connection_kwargs.get(name, 1) < TIMEOUT_LIMIT for name in TIMEOUTS):
                raise ValueError
        except (ValueError, TypeError, redis.exceptions.RedisError):  # whose words may quote a password
            raise ConfigError("--redis-url", shown(url), "its options are no good; mend what follows ?") from None
        self.url, self._prefix = url, f"rmc:{run}"
        self.refused: Counter[str] = Counter()  # what roles wrote and could not be read, by reason
        self._rests_until = 0.0  # by the monotonic clock: a Redis that hangs is left alone for as long as it took

    def _key(self, *parts: object) -> str:
        return ":".join([self._prefix, *map(str, parts)])

    def _call(self, action: Callable[..., T], *args: Any) -> T:
        if time.monotonic() < self._rests_until:
            raise BusUnavailable("Redis did not answer in time")
        try:
            return action(*args)
        except redis.exceptions.ResponseError as error:
            raise refusal(error, self.url) from None
        except redis.exceptions.TimeoutError as error:
            self._rests_until = time.monotonic() + TIMEOUT_SECONDS  # half of the time is for what needs no Redis
            raise BusUnavailable(str(error)) from None
        except (redis.exceptions.ConnectionError, OSError) as error:
            raise BusUnavailable(str(error)) from None

    def ping(self) -> None:
        """Raises BusUnavailable where no Redis answers, or one that will not have us."""
        try:
            self._call(self._redis.ping)
        except ConfigError as error:  # a Redis that knows no login repeats it
            password = self._redis.connection_pool.connection_kwargs.get("password")
            raise BusUnavailable(error.fix.replace(password or HIDDEN, HIDDEN)) from None

    def expire(self, seconds: int | None) -> None:
        """Let all that this run has in Redis vanish after so many seconds; None takes that back."""
        pattern = re.sub(r"([*?\[\]\\])", r"\\\1", self._prefix) + ":*"
        pieces = tuple(self._key(kind, "").encode() for kind in KINDS)
        heads = ((self._head(evaluate), evaluate) for evaluate in (False, True))
        named = {key.encode() for head, kind in heads if head for key in self._piece_keys(head[0], head[1], kind)}
        for key in self._call(lambda: list(self._redis.scan_iter(match=pattern, count=1000))):
            if seconds is not None:
                self._call(self._redis.expire, key, seconds)
            elif not key.startswith(pieces) or key in named:  # of other versions, pieces go anyhow
                self._call(self._redis.persist, key)

    def set_config(self, config: bytes) -> None:
        self._call(lambda: self._redis.set(self._key("config"), config))

    def config(self) -> bytes | None:
        raw: bytes | None = self._call(lambda: self._redis.get(self._key("config")))
        return raw

    def take_epoch(self, role: str, floor: int = 0) -> int:
        key = self._key("epoch", role)
        while not floor < (epoch := self._next_epoch(key, floor)) <= floor + LIVES:
            # Redis lost its data, or somebody changed them; two lives that catch up at once still get one each.
            self._call(self._redis.incrby, key, floor - epoch)
        return epoch

    def _next_epoch(self, key: str, floor: int) -> int:
        try:
            return int(self._call(lambda: self._redis.incr(key)))
        except ConfigError as error:
            if not re.search("not an integer|overflow", str(error)):
                raise
            self._call(lambda: self._redis.set(key, floor))
            return floor

    def check_room(self, role: str) -> None:
        with suppress(ConfigError):  # no number: who takes an epoch next mends it, or says so
            self._call(lambda: self._redis.incrby(self._key("epoch", role), 0))  # a write that changes nothing

    def current_epoch(self, role: str) -> int:
        return self._number(self._call(lambda: self._redis.get(self._key("epoch", role))))

    def append(self, actor: int, entry_id: EntryId, payload: bytes) -> None:
        stream = self._key("windows", actor)
        try:
            self._call(lambda: self._add_entry(actor, stream, entry_id, payload))
        except ConfigError as error:
            if not re.search("equal or smaller|exhausted the last possible ID", str(error)):
                raise
            self._check_not_fenced(actor, stream, entry_id)

    def _add_entry(self, actor: int, stream: str, entry_id: EntryId, payload: bytes) -> None:
        if entry_id.seq == 0:
            if self._number(self._redis.get(epoch := self._key("epoch", actor_role(actor)))) < entry_id.epoch:
                self._redis.set(epoch, entry_id.epoch)
            self._redis.sadd(self._key("actors"), actor)
        stored = self._redis.xadd(
            stream, {"p": payload}, id=f"{entry_id.epoch}-{entry_id.seq}", nomkstream=entry_id.seq > 0
        )
        if stored is None:
            raise _gone(stream)

    def _check_not_fenced(self, actor: int, stream: str, entry_id: EntryId) -> None:
        """A refused id is ours, stored by a retried call, unless a larger epoch that was taken wrote since."""
        try:
            last = _entry_id(self._call(lambda: self._redis.xinfo_stream(stream))["last-generated-id"])
        except ConfigError as error:
            if "no such key" not in str(error):
                raise
            raise _gone(stream) from None  # it was dropped after it had refused the id
        if last.epoch == entry_id.epoch:
            return
        if last.epoch > min(self.current_epoch(actor_role(actor)), entry_id.epoch + LIVES):
            raise BusUnavailable(f"{stream} has an entry of epoch {last.epoch}, which nobody has taken")
        raise FencedError(f"actor {actor}: epoch {last.epoch} has replaced epoch {entry_id.epoch}")

    def actors(self) -> list[int]:
        said = self._call(lambda: self._redis.smembers(self._key("actors")))
        return sorted(int(actor) for actor in said if actor.isdigit() and len(actor) <= ACTOR_DIGITS)

    def read(self, after: Mapping[int, EntryId], count: int) -> list[Entry]:
        if not after:
            return []
        return _entries(self._call(lambda: self._redis.xread(self._cursors(after), count=count)))

    def _cursors(self, after: Mapping[int, EntryId]) -> dict[str, str]:
        return {self._key("windows", actor): f"{cursor.epoch}-{max(cursor.seq, 0)}" for actor, cursor in after.items()}

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
        keys = [self._key("epoch", owner.role), *(self._key("windows", actor) for actor in actors)]
        if self._call(lambda: self._redis.eval(script, len(keys), *keys, str(owner.epoch), *words)) < 0:
            raise FencedError(f"{owner.role} epoch {owner.epoch} was replaced")

    def _commit(self, owner: ReplayOwner, acks: Mapping[int, Ack], progress: bytes) -> None:
        key = self._key("epoch", owner.role)

        def transaction(pipe: Any) -> None:
            held = self._held(pipe, owner)
            pipe.multi()
            for actor, ack in acks.items():
                pipe.xtrim(self._key("windows", actor), minid=f"{ack.id.epoch}-{ack.id.seq + 1}", approximate=False)
            if held < owner.epoch:  # Redis lost its data
                pipe.set(key, owner.epoch)
            if progress:
                pipe.hset(self._key("progress"), owner.role, progress)
            pipe.hset(
                self._key("acks"),
                mapping={
                    actor: f"{ack.id.epoch} {ack.id.seq} {ack.granted_steps} {int(ack.final)}"
                    for actor, ack in acks.items()
                },
            )

        self._call(lambda: self._redis.transaction(transaction, key))

    def progress(self, role: str) -> bytes | None:
        raw: bytes | None = self._call(lambda: self._redis.hget(self._key("progress"), role))
        return raw

    def set_progress(self, role: str, progress: bytes) -> None:
        self._call(lambda: self._redis.hsetnx(self._key("progress"), role, progress))

    def _held(self, pipe: Any, owner: ReplayOwner) -> int:
        """The newest epoch of this replay server that Redis knows. Raises FencedError where it is newer than ours."""
        held = self._number(pipe.get(self._key("epoch", owner.role)))
        if held > owner.epoch:
            raise FencedError(f"{owner.role} epoch {owner.epoch} was replaced by {held}")
        return held

    def drop_stream(self, owner: ReplayOwner, actor: int) -> None:
        self._run(DROP_SCRIPT, owner, [actor], [])

    def ack(self, actor: int) -> Ack | None:
        raw = self._call(lambda: self._redis.hget(self._key("acks"), str(actor)))
        found = self._integers(raw, 4)
        return Ack(EntryId(found[0], found[1]), found[2], bool(found[3])) if found else None

    def dead_letter(self, entry: Entry, reason: str) -> None:
        fields = {
            "actor": entry.actor,
            "id": f"{entry.id.epoch}-{entry.id.seq}",
            "reason": reason,
            "head": entry.payload[:DEAD_LETTER_BYTES],
        }
        self._call(lambda: self._redis.xadd(self._key("dead"), fields, maxlen=DEAD_LETTERS_KEPT))

    def announce_replay(self, owner: ReplayOwner, address: str) -> None:
        self._call(lambda: self._redis.hset(self._key("replay"), owner.role, f"{owner.epoch} {address}"))

    def replay_address(self, role: str) -> ReplayAddress | None:
        raw = self._call(lambda: self._redis.hget(self._key("replay"), role))
        epoch, _, address = (raw or b"").partition(b" ")
        found = self._integers(epoch, 1)
        return ReplayAddress(found[0], address.decode(errors="replace")) if found else None

    def publish_weights(self, version: Version, blob: bytes, evaluate: bool = False) -> None:
        pieces = split_pieces(blob)
        keys = self._piece_keys(version, len(pieces), evaluate)
        for key, piece in zip(keys, pieces, strict=True):  # one call each: a pipeline would make them one blob again
            self._call(self._redis.set, key, piece, UNPUBLISHED_SECONDS)
        before = self._head(evaluate)
        self._make_newest(version, f"{version.epoch} {version.update} {len(pieces)} {crc32(blob)}", keys, evaluate)
        if before is not None and before[0] != version:  # it expires rather than vanishes: a reader amid it can finish
            self._at_once("expire", self._piece_keys(before[0], before[1], evaluate), 5)

    def _make_newest(self, version: Version, head: str, pieces: list[str], evaluate: bool) -> None:
        """Name the version as the newest, and keep its pieces: those of a learner that did not come so far expire."""
        epoch_key = self._key("epoch", "learner")

        def transaction(pipe: Any) -> None:
            held = self._number(pipe.get(epoch_key))
            if held > version.epoch:
                raise FencedError(f"learner epoch {version.epoch} was replaced by {held}")
            if pipe.exists(*pieces) < len(pieces):
                raise BusUnavailable(f"weights {version.update} are gone before they were published")
            pipe.multi()
            if held < version.epoch:  # Redis lost its data: the next learner must not begin below
                pipe.set(epoch_key, version.epoch)
            for key in pieces:
                pipe.persist(key)
            pipe.set(self._key(KINDS[evaluate]), head)

        self._call(lambda: self._redis.transaction(transaction, epoch_key))

    def _integers(self, raw: bytes | None, count: int) -> list[int] | None:
        """So many numbers, as they stand in a value; None where there is no value, or another one, which is counted."""
        words = (raw or b"").split()
        if len(words) == count and all(INTEGER.fullmatch(word) for word in words):
            return [int(word) for word in words]
        self.refused["control"] += bool(raw)
        return None

    def _number(self, raw: bytes | None) -> int:
        """A number as it stands in a value; 0 where there is none."""
        return (self._integers(raw, 1) or [0])[0]

    def _head(self, evaluate: bool) -> tuple[Version, int, int] | None:
        raw = self._call(lambda: self._redis.get(self._key(KINDS[evaluate])))
        found = self._integers(raw, 4)
        if found is None or found[2] > PIECES:
            return None
        return Version(found[0], found[1]), found[2], found[3]

    def _piece_keys(self, version: Version, pieces: int, evaluate: bool) -> list[str]:
        return [self._key(KINDS[evaluate], version.epoch, version.update, index) for index in range(pieces)]

    def _at_once(self, command: str, keys: list[str], *words: object) -> list[Any]:
        """The same command for each key in one round trip; the replies stay apart."""
        pipe = self._redis.pipeline(transaction=False)
        for key in keys:
            pipe.execute_command(command, key, *words)
        replies: list[Any] = self._call(pipe.execute)
        return replies

    def latest_version(self, evaluate: bool = False) -> Version | None:
        head = self._head(evaluate)
        return head[0] if head else None

    def weights(self, evaluate: bool = False) -> tuple[Version, bytes] | None:
        head = self._head(evaluate)
        if head is None:
            return None
        version, count, crc = head
        pieces = self._at_once("get", self._piece_keys(version, count, evaluate))
        try:
            return version, join_pieces(pieces, crc)
        except MessageError:
            return None

    def emit(self, role: str, record: Mapping[str, Any]) -> None:
        key, fields = self._key("metrics", role), {"r": encode_record(record)}
        self._call(lambda: self._redis.xadd(key, fields, maxlen=METRICS_KEPT))

    def records(self, after: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, str]]:
        cursors: dict[str, str] = dict(after)
        found: list[dict[str, Any]] = []
        if not after:
            return found, cursors
        asked = {self._key("metrics", role): cursor for role, cursor in after.items()}
        reply = self._call(lambda: self._redis.xread(asked, count=RECORDS_READ))
        for name, entries in _stream_items(reply):
            role = name.decode().removeprefix(f"{self._key('metrics')}:")
            cursors[role] = entries[-1][0].decode()
            found += [{**record, "role": role} for record in map(self._record, entries) if record is not None]
            if len(entries) == RECORDS_READ:  # more than roles say: whoever does that shall not fill Redis
                self._call(self._redis.xtrim, name, METRICS_KEPT)
        return found, cursors

    def _record(self, entry: tuple[bytes, dict[bytes, bytes]]) -> dict[str, Any] | None:
        try:
            return decode_record(entry[1].get(b"r", b""))
        except MessageError as error:
            self.refused[error.reason] += 1
            return None

    def request_stop(self, reason: str) -> None:
        self._call(lambda: self._redis.set(self._key("stop"), reason))

    def stop_requested(self) -> str | None:
        raw: bytes | None = self._call(lambda: self._redis.get(self._key("stop")))
        return raw.decode(errors="replace") if raw is not None else None

    def clear_stop(self) -> None:
        self._call(lambda: self._redis.delete(self._key("stop")))


def _gone(stream: str) -> BusUnavailable:
    return BusUnavailable(f"{stream} is gone: Redis has lost its data")


def _entry_id(raw: bytes | str) -> EntryId:
    text = raw.decode() if isinstance(raw, bytes) else raw
    epoch, seq = text.split("-")
    return EntryId(int(epoch), int(seq))


def _entries(reply: Any) -> list[Entry]:
    return [
        Entry(int(name.rsplit(b":", 1)[1]), _entry_id(raw_id), fields.get(b"p", b""))
        for name, entries in _stream_items(reply)
        for raw_id, fields in entries
    ]


def _stream_items(reply: Any) -> list[tuple[bytes, list[tuple[bytes, dict[bytes, bytes]]]]]:
    """XREAD's reply as pairs, whether the protocol made it a list (RESP2) or a map (RESP3)."""
    if not reply:
        return []
    if isinstance(reply, dict):
        return [(name, chunks[0]) for name, chunks in reply.items()]
    return list(reply)
