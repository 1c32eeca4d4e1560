"""The ring: rows of windows on a memory map, and the commits that decide which of them exist.

Every window has a serial; its slot is serial mod capacity. An append (a) commits ``valid_from`` past the
rows about to be overwritten, (b) writes the rows, (c) commits ``next_serial`` with all other progress.
Killed anywhere (kill -9 included), the file says exactly which windows are whole: what the process stored
in the map outlives it in the page cache. A power cut may lose or tear what the kernel had not yet
written to disk; that is not promised against. A slot without its serial then holds no window (``holds``), and a row
that does not fit its checksum is never drawn (``gather``).
"""

import errno
import logging
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rmc.common.errors import ConfigError
from rmc.common.replay import ObservationStatistics
from rmc.common.row_checksum import add_checksums, whole_rows
from rmc.common.window import Rows, Slots, WindowSpec
from rmc.replay_server.commit_record import Progress, RecordPair, record_bytes
from rmc.replay_server.former_rows import former_fingerprints, former_row_bytes
from rmc.replay_server.row_check import row_faults

_IDENTITY = struct.Struct("<8s16sQQ")  # magic, fingerprint, capacity, row bytes; then its CRC
_IDENTITY_BYTES = 4096
_MAGIC = b"RMCRING3"
REWRITTEN_ROWS = 4096  # at once
log = logging.getLogger(__name__)
Serials = NDArray[np.int64]


class Ring:
    """``capacity`` rows in one file. ``progress`` is what ``commit`` makes durable.

    Raises ConfigError where the file belongs to other windows or another capacity, is damaged, or
    where there is no space for it. The caller keeps other processes out.
    """

    def __init__(self, path: Path, spec: WindowSpec, capacity: int) -> None:
        self.spec, self.capacity = spec, capacity
        if not path.exists():
            _create(path, spec, capacity)
        if _check_identity(path, spec, capacity) in former_fingerprints(spec):
            _rewrite(path, spec, capacity)
        start = _rows_start(spec)
        self._head = np.memmap(path, np.uint8, "r+", shape=(start,))
        self._map = np.memmap(path, np.dtype((np.void, spec.dtype.itemsize)), "r+", offset=start, shape=(capacity,))
        self._blocks = self._map.view(np.ndarray)  # whole rows, copied as such
        self.rows: Rows = self._blocks.view(spec.dtype)
        self._records = _records(self._head, spec)
        progress = self._records.read()
        if progress is None:
            raise _unusable(path, "both commit records are damaged")
        self.progress = progress

    def write(self, rows: Rows) -> Slots:
        """Steps (a) and (b): stamp serials and checksums into (n,) writable rows and store them; not sampled before
        ``commit``.

        Returns the slots written. Of more rows than the ring holds only the last are stored.
        """
        serials = np.arange(self.progress.next_serial, self.progress.next_serial + len(rows))
        rows["serial"] = serials
        add_checksums(rows[-self.capacity :])
        valid_from = min(self.progress.next_serial, self.progress.next_serial + len(rows) - self.capacity)
        if valid_from > self.progress.valid_from:
            self.progress.valid_from = valid_from
            self._records.write(self.progress)
        slots: Slots = serials[-self.capacity :] % self.capacity
        self._blocks[slots] = rows[-self.capacity :].view(self._blocks.dtype)
        return slots

    def commit(self, rows: int = 0) -> None:
        """Step (c): make so many ``rows`` just written and everything in ``progress`` durable at once."""
        self.progress.next_serial += rows
        self.progress.valid_from = max(self.progress.valid_from, self.progress.next_serial - self.capacity)
        self._records.write(self.progress)

    def holds(self, serials: Serials) -> NDArray[np.bool_]:
        """Which of (n,) windows are in the ring, whole as far as their serial tells."""
        valid = (serials >= self.progress.valid_from) & (serials < self.progress.next_serial)
        held: NDArray[np.bool_] = valid & (self.rows["serial"][serials % self.capacity] == serials)
        return held

    def gather(self, slots: Slots, out: Rows) -> NDArray[np.bool_]:
        """Copy whole rows (B,) into ``out``; which of them are still windows, in their place."""
        np.take(self._blocks, slots, out=out.view(self._blocks.dtype), mode="clip")  # clip: unbuffered
        serials = out["serial"]
        valid = (serials >= self.progress.valid_from) & (serials < self.progress.next_serial)
        sound: NDArray[np.bool_] = valid & (serials % self.capacity == slots) & whole_rows(out)
        return sound

    def forget(self, slots: Slots) -> None:
        """Hold no windows there any more."""
        self.rows["serial"][slots] = -1

    def flush_commit(self) -> None:
        """Hand the last commit to the disk, though perhaps not its rows."""
        self._head.flush()

    def flush(self) -> None:
        """Hand everything to the disk."""
        self._map.flush()
        self._head.flush()


def _rows_start(spec: WindowSpec) -> int:
    return _IDENTITY_BYTES + 2 * record_bytes(spec)


def _records(head: NDArray[np.uint8], spec: WindowSpec) -> RecordPair:
    return RecordPair(head.view(np.ndarray)[_IDENTITY_BYTES:], spec)


def file_bytes(spec: WindowSpec, capacity: int) -> int:
    """What the file of a ring takes."""
    return _rows_start(spec) + capacity * spec.dtype.itemsize


def _identity(spec: WindowSpec, capacity: int) -> bytes:
    packed = _IDENTITY.pack(_MAGIC, spec.fingerprint.encode(), capacity, spec.dtype.itemsize)
    return packed + struct.pack("<I", zlib.crc32(packed))


def _create(path: Path, spec: WindowSpec, capacity: int) -> None:
    """Under another name first, so that a ring is there whole or not at all."""
    temporary = path.with_suffix(".tmp")
    reserve(temporary, file_bytes(spec, capacity), capacity)
    _write_head(temporary, spec, capacity, Progress(ObservationStatistics.none(spec)))
    temporary.rename(path)


def _write_head(path: Path, spec: WindowSpec, capacity: int, progress: Progress) -> None:
    head = np.memmap(path, np.uint8, "r+", shape=(_rows_start(spec),))
    identity = _identity(spec, capacity)
    head[: len(identity)] = np.frombuffer(identity, np.uint8)
    _records(head, spec).write(progress)


def _rewrite(path: Path, spec: WindowSpec, capacity: int) -> None:
    """In place of a ring of an older format the same with this format's rows; killed amid it, the old one is there.

    Old rows begin as ours do: what lies behind them is the checksum, and up to it zeros.
    """
    size, start = former_row_bytes(spec), _rows_start(spec)
    head = np.memmap(path, np.uint8, "r", shape=(start,))
    progress = _records(head, spec).read()
    if progress is None:
        raise _unusable(path, "both commit records are damaged")
    old = np.memmap(path, np.uint8, "r", offset=start, shape=(capacity, size))
    temporary = path.with_suffix(".tmp")
    try:
        reserve(temporary, file_bytes(spec, capacity), capacity)
    except ConfigError:
        needed = f"{file_bytes(spec, capacity) / 2**30:.2f} GiB in {path.parent}"
        fix = f"its ring is of an older version, and rewriting it needs {needed}; free that much and start again"
        raise ConfigError("--run-dir", str(path), fix) from None
    _write_head(temporary, spec, capacity, progress)
    new = np.memmap(temporary, np.uint8, "r+", offset=start, shape=(capacity, spec.dtype.itemsize))  # padding, too
    for begin in range(0, capacity, REWRITTEN_ROWS):
        part = new[begin : begin + REWRITTEN_ROWS]
        part[:, :size] = old[begin : begin + REWRITTEN_ROWS]
        rows = part.view(np.ndarray).view(spec.dtype)[:, 0]
        add_checksums(rows)
        rows["checksum"][row_faults(rows, spec) > 0] ^= 1  # older rows have none that says whether they are whole
    new.flush()
    temporary.rename(path)
    log.info("replay ring: rewritten for this version, %d windows", progress.windows)


def reserve(path: Path, size: int, capacity: int) -> None:
    """A file of ``size`` bytes whose space is taken now: a full disk under a sparse map would be a SIGBUS."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        if size > shutil.disk_usage(path.parent).free:  # do not fill the disk just to find that out
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(handle, 0, size)
        else:  # macOS
            os.ftruncate(handle, size)
    except OSError as error:
        path.unlink()
        need = f"so many windows of a replay server need {size / 2**30:.2f} GiB in {path.parent} ({error.strerror})"
        fix = f"{need}; lower it or choose another --run-dir"
        raise ConfigError("--capacity", capacity, fix) from None
    finally:
        os.close(handle)


def _check_identity(path: Path, spec: WindowSpec, capacity: int) -> str:
    """The fingerprint of its windows, this version's or an older one's. Raises ConfigError."""
    with path.open("rb") as file:
        raw = file.read(_IDENTITY.size + 4)
    if len(raw) < _IDENTITY.size + 4 or zlib.crc32(raw[:-4]) != struct.unpack("<I", raw[-4:])[0]:
        raise _unusable(path, "not a replay ring, or a damaged one")
    magic, fingerprint, stored, row_bytes = _IDENTITY.unpack(raw[:-4])
    if magic != _MAGIC:
        raise _unusable(path, "made by another version")
    layout: str = fingerprint.decode()
    if layout not in (spec.fingerprint, *former_fingerprints(spec)):
        fix = f"its windows are of layout {layout}, this run's of {spec.fingerprint}; use a new folder"
        raise ConfigError("--run-dir", str(path), fix)
    if stored != capacity:
        fix = f"the ring in {path.parent} has {stored}; keep that or use a new --run-dir"
        raise ConfigError("--capacity", capacity, fix)
    if path.stat().st_size != _rows_start(spec) + capacity * row_bytes:
        raise _unusable(path, "cut short")
    return layout


def _unusable(path: Path, fault: str) -> ConfigError:
    return ConfigError("--run-dir", str(path), f"{fault}; delete {path.parent} to start with an empty replay")
