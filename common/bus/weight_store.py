"""Policies in Redis: pieces of 256 KiB, and a head that names the newest version."""

from typing import Any

from isal.isal_zlib import crc32

from rmc.common.bus.protocol import Version, join_pieces, split_pieces
from rmc.common.bus.redis_connection import RedisConnection
from rmc.common.errors import BusUnavailable, FencedError, MessageError

KINDS = ("weights", "evaluate")  # of policies: what acts, and what is evaluated
PIECES = 4096  # of a policy, at most: 1 GiB
REPLACED_SECONDS = 5  # that the pieces of the version before are kept
UNPUBLISHED_SECONDS = 300  # that a piece is kept whose version has not become the newest: far more than all take


class WeightStore:
    """The newest policy that acts, and the newest to evaluate. Its methods are those of ``Bus``."""

    def __init__(self, connection: RedisConnection) -> None:
        self._connection = connection

    def pieces(self) -> tuple[tuple[bytes, ...], set[bytes]]:
        """How keys of pieces begin, and the keys of those that the heads name."""
        begin = tuple(self._connection.key(kind, "").encode() for kind in KINDS)
        heads = ((self._head(evaluate), evaluate) for evaluate in (False, True))
        return begin, {key.encode() for head, kind in heads if head for key in self._piece_keys(head[0], head[1], kind)}

    def publish(self, version: Version, blob: bytes, evaluate: bool = False) -> None:
        pieces = split_pieces(blob)
        keys = self._piece_keys(version, len(pieces), evaluate)
        for key, piece in zip(keys, pieces, strict=True):  # one call each: a pipeline would make them one blob again
            self._connection.call(self._connection.redis.set, key, piece, UNPUBLISHED_SECONDS)
        head = f"{version.epoch} {version.update} {len(pieces)} {crc32(blob)}"
        if not self._make_newest(version, head, keys, evaluate):  # only the whole can be repeated, not this call
            raise BusUnavailable(f"weights {version.update} are gone before they were published")

    def _make_newest(self, version: Version, head: str, pieces: list[str], evaluate: bool) -> bool:
        """Name the version as the newest, and keep its pieces: those of a learner that did not come so far expire.

        Those of the version before expire rather than vanish: a reader amid them can finish. Whether all of this one's
        are there still; if not, nothing is named. Raises FencedError.
        """
        epoch_key, head_key = self._connection.key("epoch", "learner"), self._connection.key(KINDS[evaluate])

        def transaction(pipe: Any) -> bool:
            held = self._connection.number(pipe.get(epoch_key))
            if held > version.epoch:
                raise FencedError(f"learner epoch {version.epoch} was replaced by {held}")
            if pipe.exists(*pieces) < len(pieces):
                return False
            before = self._parsed(pipe.get(head_key))
            pipe.multi()
            if held < version.epoch:  # Redis lost its data: the next learner must not begin below
                pipe.set(epoch_key, version.epoch)
            for key in pieces:
                pipe.persist(key)
            pipe.set(head_key, head)
            if before is not None and before[0] != version:
                for key in self._piece_keys(before[0], before[1], evaluate):
                    pipe.expire(key, REPLACED_SECONDS)
            return True

        made: bool = self._connection.call(
            lambda: self._connection.redis.transaction(transaction, epoch_key, value_from_callable=True)
        )
        return made

    def _head(self, evaluate: bool) -> tuple[Version, int, int] | None:
        return self._parsed(self._connection.call(self._connection.redis.get, self._connection.key(KINDS[evaluate])))

    def _parsed(self, raw: Any) -> tuple[Version, int, int] | None:
        head = self._connection.integers(raw, 4)
        if head is None or head[2] > PIECES:
            return None
        return Version(head[0], head[1]), head[2], head[3]

    def _piece_keys(self, version: Version, pieces: int, evaluate: bool) -> list[str]:
        return [self._connection.key(KINDS[evaluate], version.epoch, version.update, index) for index in range(pieces)]

    def latest(self, evaluate: bool = False) -> Version | None:
        head = self._head(evaluate)
        return head[0] if head else None

    def load(self, evaluate: bool = False) -> tuple[Version, bytes] | None:
        head = self._head(evaluate)
        if head is None:
            return None
        version, count, crc = head
        pieces = self._connection.each("get", self._piece_keys(version, count, evaluate))
        try:
            return version, join_pieces(pieces, crc)
        except MessageError:
            return None
