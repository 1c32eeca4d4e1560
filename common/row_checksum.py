"""The checksum that ends each row of a ring: given when the row is written, looked at whenever it is drawn.

A CRC-32 over data and then over its own CRC is one number, whatever the data. So all rows that are whole have the same
CRC, and so have any n of them side by side: one pass over a batch tells whether all of it is whole. Shapes: n rows.
"""

from functools import cache

import numpy as np
from isal.isal_zlib import crc32  # 7 times as fast as zlib's, more within the caches
from numpy.typing import NDArray

from rmc.common.window import CHECKSUM_BYTES, BoolArray, Rows


def add_checksums(rows: Rows) -> None:
    """Give (n,) contiguous rows, which are otherwise as they will stand in the ring, their checksums."""
    raw, size = _bytes(rows), rows.dtype.itemsize
    starts = range(0, len(raw), size)
    rows["checksum"] = [crc32(raw[start : start + size - CHECKSUM_BYTES]) for start in starts]


def whole_rows(rows: Rows) -> BoolArray:
    """Which of (n,) contiguous rows fit their checksums."""
    raw, size = _bytes(rows), rows.dtype.itemsize
    if crc32(raw) == crc_of_whole(size, len(rows)):
        return np.ones(len(rows), np.bool_)
    one = crc_of_whole(size, 1)
    return np.array([crc32(raw[start : start + size]) == one for start in range(0, len(raw), size)], np.bool_)


def _bytes(rows: Rows) -> memoryview:
    raw: NDArray[np.uint8] = rows.view(np.uint8)
    return raw.data


@cache
def crc_of_whole(size: int, count: int) -> int:
    """Of so many whole rows of so many bytes each."""
    row = bytes(size - CHECKSUM_BYTES)
    return crc32((row + crc32(row).to_bytes(CHECKSUM_BYTES, "little")) * count)
