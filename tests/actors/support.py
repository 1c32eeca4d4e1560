"""Rows in tests."""

from collections.abc import Sequence

import numpy as np

from rmc.common.window import Rows, WindowSpec


def join_rows(parts: Sequence[Rows], spec: WindowSpec) -> Rows:
    """One array, padded as a ring's rows are (concatenate would pack the fields)."""
    return np.frombuffer(bytearray(b"".join(part.tobytes() for part in parts)), spec.dtype)
