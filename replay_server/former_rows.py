"""Rows in the rings of older config formats: as ours, but without a checksum, and with one flag a frame.

In format 1 ``missing`` was called ``blank``: the same bytes.
"""

from functools import cache

import numpy as np

from rmc.common.window import WindowSpec, fingerprint, row_dtype


def former_fingerprints(spec: WindowSpec) -> tuple[str, ...]:
    """Of older windows that hold all that ours do; none where ours have what there was not."""
    if spec.missing > 1 or spec.privileged:
        return ()
    return tuple(fingerprint(spec, _former_dtype(spec, name)) for name in ("missing", "blank"))


def former_row_bytes(spec: WindowSpec) -> int:
    """Of an older row; it begins as one of ours does."""
    return _former_dtype(spec, "missing").itemsize


@cache
def _former_dtype(spec: WindowSpec, missing: str) -> np.dtype[np.void]:
    fields = spec.dtype.fields
    assert fields is not None
    kept = [(name, fields[name][0]) for name in fields if name not in ("privileged", "missing", "checksum")]
    return row_dtype([*kept, (missing, np.dtype(("u1", (spec.observations,))))], checksum=False)
