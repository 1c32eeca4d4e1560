"""Batches in memory that a replay server and a learner on the same machine share, instead of in their socket.

Batches take turns in it: rows | values (float64) each. The server writes, says so in a frame with the CRC-32 of what it
wrote, and the learner checks that where it lies. The learner asks for two ahead and may read one: so there are three.
The server has looked at the rows' own checksums, so it knows the CRC of whole rows without reading them again. That is
the same for all, so the rows' serial numbers follow: another batch than the frame's does not pass.
"""

import fcntl
import mmap
import os
from typing import Any

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from rmc.common.errors import MessageError
from rmc.common.row_checksum import crc_of_whole
from rmc.common.window import Rows, WindowSpec

TURNS = 3


class SharedBatches:
    """The memory behind a descriptor, which may be closed afterwards."""

    def __init__(self, descriptor: int, spec: WindowSpec, batch_size: int) -> None:
        """Raises OSError, ValueError where it is not of that size."""
        self.batch_size, self.turn = batch_size, 0
        self._crc_of_rows = crc_of_whole(spec.dtype.itemsize, batch_size)
        rows_bytes = batch_size * spec.dtype.itemsize
        self._bytes = np.frombuffer(mmap.mmap(descriptor, shared_bytes(spec, batch_size)), np.uint8).reshape(TURNS, -1)
        self.rows: list[Rows] = [part[:rows_bytes].view(spec.dtype) for part in self._bytes]
        self.weights: list[NDArray[np.float64]] = [part[rows_bytes:].view(np.float64) for part in self._bytes]

    def put(self, weights: NDArray[np.float64]) -> dict[str, int]:
        """Add the weights to whole rows that lie there already; what the frame says of this turn."""
        own = self.weights[self.turn]
        own[:] = weights
        crc = crc32(own.data.cast("B"), self._crc_of_rows)
        meta = {"turn": self.turn, "crc": crc32(self.rows[self.turn]["serial"].tobytes(), crc)}
        self.turn = (self.turn + 1) % TURNS
        return meta

    def take(self, meta: dict[str, Any]) -> tuple[Rows, NDArray[np.float64]]:
        """The rows and weights of a frame. Raises MessageError."""
        turn, crc = meta.get("turn"), meta.get("crc")
        if type(turn) is not int or not 0 <= turn < TURNS:
            raise MessageError("turn", f"{turn!r}, want 0 to {TURNS - 1}")
        if crc32(self.rows[turn]["serial"].tobytes(), crc32(self._bytes[turn].data)) != crc:
            raise MessageError("crc", "a batch in shared memory")
        return self.rows[turn], self.weights[turn]


def shared_bytes(spec: WindowSpec, batch_size: int) -> int:
    """Of all turns together."""
    return TURNS * batch_size * (spec.dtype.itemsize + 8)


def reserve_memory(size: int) -> int | None:
    """A descriptor of memory that nobody can cut short under the other; None where there is none to be had."""
    if not hasattr(os, "memfd_create"):  # macOS
        return None
    try:
        descriptor = os.memfd_create("rmc-batches", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    except OSError:  # a sandbox refuses it
        return None
    try:
        os.posix_fallocate(descriptor, 0, size)  # a page that is missing later would be a SIGBUS
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor
