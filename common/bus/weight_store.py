"""Policies in Redis: pieces of 256 KiB, and a head that names the newest version."""

from collections.abc import Sequence
from typing import Any

from isal.isal_zlib import crc32

from rmc.common.bus.protocol import Version
from rmc.common.bus.redis_connection import RedisConnection
from rmc.common.errors import BusUnavailable, FencedError, MessageError

KINDS = ("weights", "evaluate")  # of policies: what acts, and what is evaluated
PIECE_BYTES = 256 * 1024  # 10 MB blobs collapse redis-py; pieces of this size run at memory speed
PIECES = 4096  # of a policy, at most
LARGEST_BYTES = PIECES * PIECE_BYTES  # 1 GiB
REPLACED_SECONDS = 5  # that the pieces of the version before are kept
UNPUBLISHED_SECONDS = 300  # that a piece is kept whose version has not become the newest: far more than all take


class WeightStore(RedisConnection):
    """The newest policy that acts, and the newest to evaluate: their part of ``Bus``."""

    def piece_keys(self) -> tuple[tuple[bytes, ...], set[bytes]]:
        """How keys of pieces begin, and the keys of those that the heads name."""
        begin = tuple(self.key(kind, "").encode() for kind in KINDS)
        heads = ((self._head(evaluate), evaluate) for evaluate in (False, True))
        return begin, {key.encode() for head, kind in heads if head for key in self._keys_of(head[0], head[1], kind)}

    def publish_weights(self, version: Version, blob: bytes, evaluate: bool = False) -> None:
        pieces = [blob[at : at + PIECE_BYTES] for at in range(0, max(len(blob), 1), PIECE_BYTES)]
        keys = self._keys_of(version, len(pieces), evaluate)
        for key, piece in zip(keys, pieces, strict=True):  # one call each: a pipeline would make them one blob again
            self.call(self.redis.set, key, piece, UNPUBLISHED_SECONDS)
        head = f"{version.epoch} {version.update} {len(pieces)} {crc32(blob)}"
        if not self._make_newest(version, head, keys, evaluate):  # only the whole can be repeated, not this call
            raise BusUnavailable(f"weights {version.update} are gone before they were published")

    def _make_newest(self, version: Version, head: str, pieces: list[str], evaluate: bool) -> bool:
        """Name the version as the newest, and keep its pieces: those of a learner that did not come so far expire.

        Those of the version before expire rather than vanish: a reader amid them can finish. Whether all of this one's
        are there still; if not, nothing is named. Raises FencedError.
        """
        epoch_key, head_key = self.key("epoch", "learner"), self.key(KINDS[evaluate])

        def transaction(pipe: Any) -> bool:
            held = self.number(pipe.get(epoch_key))
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
                for key in self._keys_of(before[0], before[1], evaluate):
                    pipe.expire(key, REPLACED_SECONDS)
            return True

        made: bool = self.call(lambda: self.redis.transaction(transaction, epoch_key, value_from_callable=True))
        return made

    def _head(self, evaluate: bool) -> tuple[Version, int, int] | None:
        return self._parsed(self.call(self.redis.get, self.key(KINDS[evaluate])))

    def _parsed(self, raw: Any) -> tuple[Version, int, int] | None:
        head = self.integers(raw, 4)
        if head is None or head[2] > PIECES:
            return None
        return Version(head[0], head[1]), head[2], head[3]

    def _keys_of(self, version: Version, pieces: int, evaluate: bool) -> list[str]:
        return [self.key(KINDS[evaluate], version.epoch, version.update, index) for index in range(pieces)]

    def latest_version(self, evaluate: bool = False) -> Version | None:
        head = self._head(evaluate)
        return head[0] if head else None

    def weights(self, evaluate: bool = False) -> tuple[Version, bytes] | None:
        head = self._head(evaluate)
        if head is None:
            return None
        version, count, crc = head
        pieces = self.each("get", self._keys_of(version, count, evaluate))
        try:
            return version, join_pieces(pieces, crc)
        except MessageError:
            return None


def join_pieces(pieces: Sequence[bytes | None], crc: int) -> bytes:
    """The blob again. Raises MessageError where a piece is missing or the CRC-32 differs."""
    if any(piece is None for piece in pieces):
        raise MessageError("weights", "a piece is gone: a newer version has replaced this one")
    blob = b"".join(piece for piece in pieces if piece is not None)
    if crc32(blob) != crc:
        raise MessageError("crc", "weights")
    return blob
