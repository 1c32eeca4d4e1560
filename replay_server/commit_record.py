"""The commit record: what one commit makes durable, in two alternating copies with a CRC.

Copy = header "<QII" (sequence, length, crc32(sequence + length + payload)) + payload
Payload = fixed counters | statistics total, square (D float64 each) | streams (n, 4) int64 | replay ratio, float64 |
further counts of the statistics (C - 1 int64)
Rings of config format 1 end before the replay ratio. D numbers have statistics, of C counts: see ``WindowSpec``.
The copy with the larger valid sequence is the present state; a torn write only spoils the older one.
"""

import math
import struct
import zlib
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rmc.common.bus.protocol import EntryId
from rmc.common.errors import ConfigError
from rmc.common.replay import ObservationStatistics
from rmc.common.window import WindowSpec

MAX_STREAMS = 4096
MOST = 2**62  # of a counter that a bus has kept: who adds to it must not overflow
_HEADER = struct.Struct("<QII")
_COUNTERS = struct.Struct("<10qdqq")  # the integers of Progress in order, largest priority, statistics count, streams
_STREAM_BYTES = 4 * 8
_RATIO = struct.Struct("<d")
_CRC = struct.Struct("<I")


class StreamPosition(NamedTuple):
    """How far an actor's stream is in the ring."""

    id: EntryId  # the last entry taken
    settled_steps: int  # agent steps of epoch ``id.epoch`` that were inserted, or lost with a refused entry


@dataclass
class Progress:
    """The replay's counters. Mutable: the server changes it, then commits it."""

    observed: ObservationStatistics
    valid_from: int = 0  # the oldest serial that may be sampled
    next_serial: int = 0
    env_steps: int = 0  # inserted
    drawn_steps: int = 0  # trained steps drawn
    draws: int = 0
    replay_epoch: int = 0  # the largest that has written here
    evicted_priorities: int = 0  # priorities that came back too late
    elsewhere_steps: int = 0  # trained steps drawn from the other shards, as the learner last said
    begun_env_steps: int = 0  # agent steps that were in before this ring began, empty
    begun_drawn_steps: int = 0  # and trained steps that were drawn, from all shards
    max_priority: float = 1.0  # a new window's
    streams: dict[int, StreamPosition] = field(default_factory=dict)
    replay_ratio: float = 0.0  # that the limiter held since this ring began; 0 where nobody has said it

    @property
    def windows(self) -> int:
        """How many windows may be sampled."""
        return self.next_serial - self.valid_from

    @property
    def inserted(self) -> int:
        """Agent steps inserted since this ring began, which is where the limiter counts from."""
        return self.env_steps - self.begun_env_steps

    @property
    def drawn(self) -> int:
        """Trained steps drawn since this ring began, from all shards."""
        return self.drawn_steps + self.elsewhere_steps - self.begun_drawn_steps

    def is_after(self, other: "Progress") -> bool:
        """Whether something was taken in or drawn here that the other, of the same ring, does not know of."""
        news = (actor not in other.streams or at.id > other.streams[actor].id for actor, at in self.streams.items())
        return self.draws > other.draws or any(news)

    def encode(self) -> bytes:
        """Raises ConfigError for more than 4096 streams."""
        if len(self.streams) > MAX_STREAMS:
            raise ConfigError("--actors", len(self.streams), f"a replay server takes at most {MAX_STREAMS} streams")
        counters = _COUNTERS.pack(
            self.valid_from, self.next_serial, self.env_steps, self.drawn_steps, self.draws, self.replay_epoch,
            self.evicted_priorities, self.elsewhere_steps, self.begun_env_steps, self.begun_drawn_steps,
            self.max_priority, int(self.observed.count[0]), len(self.streams),
        )  # fmt: skip
        rows = [(actor, at.id.epoch, at.id.seq, at.settled_steps) for actor, at in self.streams.items()]
        streams = np.array(rows, np.int64).tobytes()
        sums = self.observed.total.tobytes() + self.observed.total_square.tobytes()
        return counters + sums + streams + _RATIO.pack(self.replay_ratio) + self.observed.count[1:].tobytes()

    def publish(self) -> bytes:
        """The same for a bus and for files, with a CRC-32 in front."""
        payload = self.encode()
        return _CRC.pack(zlib.crc32(payload)) + payload


def crc_matches(published: bytes) -> bool:
    """Whether this is as ``Progress.publish`` made it."""
    return published[: _CRC.size] == _CRC.pack(zlib.crc32(published[_CRC.size :]))


def decode_progress(payload: bytes, spec: WindowSpec) -> Progress:
    """The inverse of ``Progress.encode``, for bytes whose CRC was right."""
    *counters, observations, streams = _COUNTERS.unpack_from(payload)
    sums = np.frombuffer(payload, np.float64, 2 * spec.statistics, _COUNTERS.size).reshape(2, -1).copy()
    table = np.frombuffer(payload, np.int64, 4 * streams, _COUNTERS.size + sums.nbytes).reshape(-1, 4)
    positions = {actor: StreamPosition(EntryId(epoch, seq), steps) for actor, epoch, seq, steps in table.tolist()}
    rest = payload[_COUNTERS.size + sums.nbytes + table.nbytes :]
    count = np.array([observations, *np.frombuffer(rest[_RATIO.size :], np.int64)])
    progress = Progress(ObservationStatistics(count, *sums), *counters)
    progress.streams, progress.replay_ratio = positions, _RATIO.unpack_from(rest)[0] if rest else 0.0
    return progress


def decode_published(published: bytes, spec: WindowSpec) -> Progress | None:
    """``Progress.publish`` as a bus has kept it; None where it is damaged, or no ring of such windows says it."""
    payload = published[_CRC.size :]
    if not crc_matches(published) or len(payload) < _COUNTERS.size:
        return None
    *counters, max_priority, observations, streams = _COUNTERS.unpack_from(payload)
    in_range = all(0 <= count <= MOST for count in (*counters, observations)) and 0 <= streams <= MAX_STREAMS
    valid_from, next_serial, *_ = counters
    if not (in_range and valid_from <= next_serial and math.isfinite(max_priority) and max_priority > 0.0):
        return None
    size = _COUNTERS.size + 16 * spec.statistics + streams * _STREAM_BYTES
    without_ratio = [size] if spec.counts == 1 else []
    if len(payload) not in [*without_ratio, size + _RATIO.size + 8 * (spec.counts - 1)]:
        return None
    return decode_progress(payload, spec)


def record_bytes(spec: WindowSpec) -> int:
    """Room for one copy, in whole pages. A ratio always fits: without it the size is never a multiple of 16."""
    further = _RATIO.size + 8 * (spec.counts - 1) if spec.counts > 1 else 0
    size = _HEADER.size + _COUNTERS.size + 16 * spec.statistics + further + MAX_STREAMS * _STREAM_BYTES
    return -(-size // 4096) * 4096


class RecordPair:
    """Both copies, in a mapped region of ``2 * record_bytes(spec)`` bytes."""

    def __init__(self, region: NDArray[np.uint8], spec: WindowSpec) -> None:
        self._spec, half = spec, record_bytes(spec)
        self._copies = [region[:half].data, region[half : 2 * half].data]
        self._sequence = 0

    def write(self, progress: Progress) -> None:
        """Replace the older copy."""
        payload = progress.encode()
        sequence = self._sequence + 1
        crc = zlib.crc32(payload, zlib.crc32(struct.pack("<QI", sequence, len(payload))))
        packed = _HEADER.pack(sequence, len(payload), crc) + payload
        self._copies[sequence % 2][: len(packed)] = packed
        self._sequence = sequence

    def read(self) -> Progress | None:
        """The newest valid copy, or None where both are damaged."""
        copies = [(sequence, payload) for sequence, payload in map(_read_copy, self._copies) if payload is not None]
        if not copies:
            return None
        self._sequence, payload = max(copies)
        return decode_progress(payload, self._spec)


def _read_copy(copy: memoryview) -> tuple[int, bytes | None]:
    sequence, length, crc = _HEADER.unpack_from(copy)
    if length < _COUNTERS.size or length > len(copy) - _HEADER.size:
        return sequence, None
    payload = bytes(copy[_HEADER.size : _HEADER.size + length])
    valid = zlib.crc32(payload, zlib.crc32(struct.pack("<QI", sequence, length))) == crc
    return sequence, payload if valid else None
