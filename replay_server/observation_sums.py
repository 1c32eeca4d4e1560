"""Sums over new observations, by which they are normalised, in one pass over the rows.

Shapes: n rows, T + 1 observations, O observation, M flags of what is missing, P privileged, F floats of a row.
"""

import numpy as np
from numpy.typing import NDArray

from rmc.common.compiled import compiled
from rmc.common.replay import ObservationStatistics
from rmc.common.window import Rows, WindowSpec


@compiled
def _add_up(
    floats: NDArray[np.float32],
    offset: int,
    missing: NDArray[np.uint8],
    new: NDArray[np.int32],
    last: NDArray[np.int32],
    count: NDArray[np.int64],
    total: NDArray[np.float64],
    total_square: NDArray[np.float64],
) -> None:
    """(n, F) with K numbers an observation from ``offset`` on, (n, T + 1, M), (n,), (n,), adds to (M,), (K,) twice."""
    size, flags = total.shape[0], missing.shape[2]
    for row in range(floats.shape[0]):
        for t in range(last[row] - new[row] + 1, last[row] + 1):
            start = offset + t * size
            for flag in range(flags):
                if missing[row, t, flag] != 0:
                    continue
                count[flag] += 1
                for k in range(flag, flag + 1) if flags > 1 else range(size):
                    value = np.float64(floats[row, start + k])
                    total[k] += value
                    total_square[k] += value * value


def observation_sums(rows: Rows, spec: WindowSpec) -> ObservationStatistics:
    """Over what no earlier window carried and what is not missing; padding is never read."""
    parts = [("observation", spec.obs_dim, rows["missing"])]
    if spec.privileged:
        parts.append(("privileged", spec.privileged, np.zeros((len(rows), spec.observations, 1), np.uint8)))
    new, last = np.minimum(rows["new_observations"], rows["last"] + 1), rows["last"]
    floats = rows.view(np.float32).reshape(len(rows), spec.dtype.itemsize // 4)
    assert spec.dtype.fields is not None
    sums = []
    for name, size, missing in parts:
        count, total, total_square = np.zeros(missing.shape[2], np.int64), np.zeros(size), np.zeros(size)
        _add_up(floats, spec.dtype.fields[name][1] // 4, missing, new, last, count, total, total_square)
        sums.append((count if spec.counts == 1 else np.broadcast_to(count, size), total, total_square))
    return ObservationStatistics(*map(np.concatenate, zip(*sums, strict=True)))
