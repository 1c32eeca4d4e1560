"""Sums over new observations, by which they are normalised, in one pass over the rows.

Shapes: n rows, T + 1 observations, O observation, F floats of a row.
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
    total: NDArray[np.float64],
    total_square: NDArray[np.float64],
) -> int:
    """(n, F) with observations from ``offset`` on, (n, T + 1), (n,), (n,), adds to (O,) twice; how many there were."""
    count, size = 0, total.shape[0]
    for row in range(floats.shape[0]):
        for t in range(last[row] - new[row] + 1, last[row] + 1):
            if missing[row, t] == 0:
                count += 1
                start = offset + t * size
                for o in range(size):
                    value = np.float64(floats[row, start + o])
                    total[o] += value
                    total_square[o] += value * value
    return count


def observation_sums(rows: Rows, spec: WindowSpec) -> ObservationStatistics:
    """Over the observations that no earlier window carried and that are not missing; padding is never read."""
    total, total_square = np.zeros(spec.obs_dim), np.zeros(spec.obs_dim)
    assert spec.dtype.fields is not None
    offset = spec.dtype.fields["observation"][1] // 4
    floats = rows.view(np.float32).reshape(len(rows), spec.dtype.itemsize // 4)
    new, last = np.minimum(rows["new_observations"], rows["last"] + 1), rows["last"]
    count = _add_up(floats, offset, rows["missing"], new, last, total, total_square)
    return ObservationStatistics(count, total, total_square)
