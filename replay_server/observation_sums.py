"""Sums over new observations, by which they are normalised, in one pass over the rows.

Shapes: n rows, T + 1 observations, O observation, M flags of what is missing, P privileged, F floats of a row.
"""

import numpy as np
from numpy.typing import NDArray

from rmc.common.agent_config import STD_FLOOR
from rmc.common.compiled import compiled
from rmc.common.replay import ObservationStatistics
from rmc.common.window import Rows, WindowSpec

SETTLED = 50  # observations from which on the sums tell what a number may be
FARTHEST = 100.0  # standard deviations from the mean that one counts as at most


@compiled
def _add_up(
    floats: NDArray[np.float32],
    offset: int,
    missing: NDArray[np.uint8],
    new: NDArray[np.int32],
    last: NDArray[np.int32],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    count: NDArray[np.int64],
    total: NDArray[np.float64],
    total_square: NDArray[np.float64],
) -> None:
    """(n, F) with K numbers an observation from ``offset`` on, (n, T + 1, M), (n,), (n,), adds to (M,), (K,) twice.

    A number counts as within (K,) ``low`` and ``high``.
    """
    size, flags = total.shape[0], missing.shape[2]
    for row in range(floats.shape[0]):
        for t in range(last[row] - new[row] + 1, last[row] + 1):
            start = offset + t * size
            for flag in range(flags):
                if missing[row, t, flag] != 0:
                    continue
                count[flag] += 1
                for k in range(flag, flag + 1) if flags > 1 else range(size):
                    value = min(max(np.float64(floats[row, start + k]), low[k]), high[k])
                    total[k] += value
                    total_square[k] += value * value


def _plausible(known: ObservationStatistics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(D,) lowest and highest that a number counts as: one of a simulator that explodes must not blind the rest."""
    count = np.maximum(known.count, 1)
    mean = known.total / count
    std = np.sqrt(np.maximum(known.total_square / count - mean * mean, 0.0))
    reach = np.where(known.count >= SETTLED, FARTHEST * np.maximum(std, STD_FLOOR), np.inf)
    return mean - reach, mean + reach


def observation_sums(rows: Rows, spec: WindowSpec, known: ObservationStatistics) -> ObservationStatistics:
    """Over what no earlier window carried and what is not missing; padding is never read.

    ``known`` are the sums so far.
    """
    parts = [("observation", spec.obs_dim, rows["missing"])]
    if spec.privileged:
        parts.append(("privileged", spec.privileged, np.zeros((len(rows), spec.observations, 1), np.uint8)))
    new, last = rows["new_observations"], rows["last"]
    floats = rows.view(np.float32).reshape(len(rows), spec.dtype.itemsize // 4)
    assert spec.dtype.fields is not None
    low, high = _plausible(known)
    sums, first = [], 0
    for name, size, missing in parts:
        count, total, total_square = np.zeros(missing.shape[2], np.int64), np.zeros(size), np.zeros(size)
        part, first = slice(first, first + size), first + size
        offset = spec.dtype.fields[name][1] // 4
        _add_up(floats, offset, missing, new, last, low[part], high[part], count, total, total_square)
        sums.append((count if spec.counts == 1 else np.broadcast_to(count, size), total, total_square))
    return ObservationStatistics(*map(np.concatenate, zip(*sums, strict=True)))
