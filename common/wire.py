"""Messages as bytes: what crosses Redis (msgpack) and the replay socket (framed msgpack + raw body).

Both carry a version, a length and a CRC-32, and are checked before they are read further. Nothing
here can execute what it reads: msgpack with limits, no extension types, no pickle.

Stream entry  = msgpack [version, kind, fingerprint, count, crc32(body), body]
Socket frame  = header "<4sBBHIIQ" (magic, version, kind, 0, len(meta), crc32(meta + body), len(body))
                + meta (msgpack map) + body (raw bytes)
"""

import hashlib
import hmac
import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import msgpack
import numpy as np
from isal.isal_zlib import crc32

from rmc.common.errors import MessageError
from rmc.common.window import Rows, WindowSpec

VERSION = 1
MAGIC = b"RMC1"
HEADER = struct.Struct("<4sBBHIIQ")
MAX_ENTRY_BYTES = 1 << 20  # 1 MiB: a chunk never grows past it, unless one window alone does
MAX_META_BYTES = 1 << 20
WINDOWS, HELLO = 1, 2
_FINGERPRINT_LENGTH = 16
_ENTRY = (int, int, str, int, int, bytes)  # version, kind, fingerprint, count, crc32, body


class Kind(IntEnum):
    """Kinds of socket frames."""

    CHALLENGE = 1  # server -> client: its nonce
    PROOF = 2  # client -> server: its nonce and HMAC, and the epoch of the learner that it is
    WELCOME = 3  # server -> client: its HMAC, window fingerprint
    SAMPLE = 4  # client -> server: batch_size, elsewhere (see ``Replay.sample``)
    BATCH = 5  # server -> client: rows | weights (float64), with total_weight, env_steps, drawn_steps
    WAIT = 6  # server -> client: the limiter holds the draw back
    FINISHED = 7  # server -> client: all steps are in and the ratio is spent
    PRIORITIES = 8  # client -> server: serials (int64) | priorities (float32); no reply
    STATISTICS = 9  # client -> server, and its reply: counts (int64) | sums | sums of squares (float64)
    ERROR = 11  # server -> client: why the connection ends; fenced: its HMAC that a newer learner has come
    EPISODE = 12  # client -> server: serial, and its reply: count, then rows
    SHARE = 13  # client -> server: batch_size, and its reply, with a descriptor where memory can be shared
    SHARED = 14  # server -> client: BATCH without its body, which lies in shared memory: turn and crc32 with the rest


NONCE_BYTES = 32  # random ones, of each side


def is_proof(received: object, expected: bytes) -> bool:
    """Whether a proof that came is the expected one, in a time that tells nothing."""
    return isinstance(received, bytes) and hmac.compare_digest(received, expected)


def proof(secret: bytes, side: bytes, challenge: bytes, nonce: bytes) -> bytes:
    """HMAC-SHA256 with which a side, ``client``, ``server`` or (it, too) ``fenced``, shows that it knows the secret."""
    return hmac.new(secret, side + challenge + nonce, hashlib.sha256).digest()


def encode_windows(rows: Rows, spec: WindowSpec) -> bytes:
    """One stream entry that carries (n,) rows."""
    body = rows.tobytes()
    packed: bytes = msgpack.packb([VERSION, WINDOWS, spec.fingerprint, len(rows), crc32(body), body], use_bin_type=True)
    return packed


def encode_hello(spec: WindowSpec) -> bytes:
    """An actor's first entry: from it on, Redis refuses smaller ids."""
    packed: bytes = msgpack.packb([VERSION, HELLO, spec.fingerprint, 0, 0, b""], use_bin_type=True)
    return packed


def max_entry_bytes(spec: WindowSpec) -> int:
    """The largest entry accepted: 1 MiB or one window, with room for the header."""
    return max(MAX_ENTRY_BYTES, spec.dtype.itemsize) + 128


def decode_rows(payload: bytes, spec: WindowSpec) -> Rows:
    """Rows of an entry, which are still to be judged; a hello has none.

    Raises MessageError with a countable reason; never anything else, whatever the bytes.
    """
    if len(payload) > max_entry_bytes(spec):
        raise MessageError("too-large", f"{len(payload)} bytes, at most {max_entry_bytes(spec)}")
    version, kind, fingerprint, count, crc, body = _unpack_entry(payload)
    if version != VERSION:
        raise MessageError("version", f"{version}, this side speaks {VERSION}")
    if fingerprint != spec.fingerprint:
        raise MessageError("fingerprint", f"{fingerprint}, this run has {spec.fingerprint}")
    if kind not in (WINDOWS, HELLO):
        raise MessageError("kind", str(kind))
    if (kind == HELLO) != (count == 0) or len(body) != count * spec.dtype.itemsize:
        raise MessageError("length", f"{len(body)} bytes for {count} rows")
    if crc32(body) != crc:
        raise MessageError("crc")
    return np.frombuffer(body, dtype=spec.dtype)


def _unpack_entry(payload: bytes) -> tuple[int, int, str, int, int, bytes]:
    """The six fields."""
    try:
        fields = msgpack.unpackb(
            payload, raw=False, max_array_len=len(_ENTRY), max_map_len=0, max_str_len=_FINGERPRINT_LENGTH, max_ext_len=0
        )
    except Exception as error:  # msgpack raises several unrelated classes on hostile bytes
        raise MessageError("msgpack", type(error).__name__) from None
    if not isinstance(fields, list) or tuple(map(type, fields)) != _ENTRY:
        raise MessageError("structure", "not the six fields of an entry")
    version, kind, fingerprint, rows, crc, body = fields
    return version, kind, fingerprint, rows, crc, body


class FrameHeader(NamedTuple):
    """The fixed part of a socket frame; ``body_length`` bytes follow ``meta_length`` bytes."""

    kind: Kind
    meta_length: int
    crc: int
    body_length: int


def encode_frame(kind: Kind, meta: Mapping[str, Any], body_parts: tuple[bytes | memoryview, ...] = ()) -> bytes:
    """Header and meta of a frame whose body is the parts in order; the parts are sent after it."""
    packed: bytes = msgpack.packb(dict(meta), use_bin_type=True)
    crc = crc32(packed)
    for part in body_parts:
        crc = crc32(part, crc)
    length = sum(memoryview(part).nbytes for part in body_parts)
    return HEADER.pack(MAGIC, VERSION, int(kind), 0, len(packed), crc, length) + packed


def decode_header(raw: bytes, max_body: int) -> FrameHeader:
    """The header, with sizes checked before anything of that size is read. Raises MessageError."""
    magic, version, kind, _, meta_length, crc, body_length = HEADER.unpack(raw)
    if magic != MAGIC or version != VERSION:
        raise MessageError("version", "not a frame of this version")
    if kind not in Kind._value2member_map_:
        raise MessageError("kind", str(kind))
    if meta_length > MAX_META_BYTES or body_length > max_body:
        raise MessageError("too-large", f"meta {meta_length}, body {body_length}, at most {max_body}")
    return FrameHeader(Kind(kind), meta_length, crc, body_length)


def decode_meta(raw: bytes, body: bytes | memoryview, header: FrameHeader) -> dict[str, Any]:
    """The meta map of a frame, its CRC checked with the body's. Raises MessageError."""
    if crc32(body, crc32(raw)) != header.crc:
        raise MessageError("crc")
    try:
        meta = msgpack.unpackb(raw, raw=False, strict_map_key=True, max_map_len=256, max_array_len=4096, max_ext_len=0)
    except Exception as error:  # msgpack raises several unrelated classes on hostile bytes
        raise MessageError("msgpack", type(error).__name__) from None
    if not isinstance(meta, dict):
        raise MessageError("structure", "meta is not a map")
    return meta
