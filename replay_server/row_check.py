"""Judges rows as windows of this run when they come in; from then on their checksums tell what a disk has changed.

Shapes: n rows, W words of four bytes in a row, F of them floats that must be finite.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from rmc.common.compiled import compiled
from rmc.common.window import Rows, WindowSpec

INTEGERS = ("first", "last", "new_steps", "new_observations", "episode_step", "env")
FLOATS = ("initial_priority", "observation", "action", "prev_action", "reward", "state", "privileged")  # side by side
FAULTS = (
    "",
    "first is neither 0 nor burn_in",
    "last is outside (burn_in, T]",
    "new_steps exceeds the trained steps",
    "a burn-in before its episode's start",
    "new_observations is neither new_steps nor one more",
    "env is negative",
    "episode_step is negative",
    "initial_priority is negative",
    *(f"{name} is not finite" for name in FLOATS),
)
NOT_FINITE = len(FAULTS) - len(FLOATS)
TINY = np.float32(1e-6)  # times all floats of a row, their sum is finite where they are


@compiled
def _judge(
    words: NDArray[np.int32],
    priorities: NDArray[np.float32],
    at: tuple[int, ...],
    burn_in: int,
    steps: int,
    faults: NDArray[np.uint8],
) -> None:
    """(n, W), (n,), columns of ``INTEGERS`` -> (n,) indices into ``FAULTS``, of all but what is not finite."""
    for row in range(words.shape[0]):
        first, last, new_steps = words[row, at[0]], words[row, at[1]], words[row, at[2]]
        new_observations, episode_step, env = words[row, at[3]], words[row, at[4]], words[row, at[5]]
        if first != 0 and first != burn_in:
            faults[row] = 1
        elif last <= burn_in or last > steps:
            faults[row] = 2
        elif new_steps < 0 or new_steps > last - burn_in:
            faults[row] = 3
        elif first == 0 and episode_step < burn_in:
            faults[row] = 4
        elif new_observations < new_steps or new_observations > new_steps + 1:
            faults[row] = 5
        elif env < 0:
            faults[row] = 6
        elif episode_step < 0:
            faults[row] = 7
        elif priorities[row] < 0.0:
            faults[row] = 8


@cache
def _columns(spec: WindowSpec) -> tuple[tuple[int, ...], slice, NDArray[np.float32]]:
    """Columns of ``INTEGERS`` and of all ``FLOATS`` among a row's words, and (F,) of ``TINY``."""
    assert spec.dtype.fields is not None
    column = {name: int(field[1]) // 4 for name, field in spec.dtype.fields.items()}
    floats = slice(column[FLOATS[0]], column["missing"])
    return tuple(column[name] for name in INTEGERS), floats, np.full(floats.stop - floats.start, TINY)


def row_faults(rows: Rows, spec: WindowSpec) -> NDArray[np.uint8]:
    """(n,) aligned, contiguous rows -> (n,) indices into ``FAULTS``; 0 where a row can be a window of this run."""
    at, span, tiny = _columns(spec)
    words = rows.view(np.int32).reshape(len(rows), spec.dtype.itemsize // 4)
    floats, faults = words.view(np.float32), np.zeros(len(rows), np.uint8)
    _judge(words, floats[:, span.start], at, spec.burn_in, spec.steps, faults)
    with np.errstate(invalid="ignore", over="ignore"):
        sums = floats[:, span] @ tiny  # by far the quickest look at all of them
    for row in np.flatnonzero(~np.isfinite(sums)).tolist():
        finite = [bool(np.isfinite(rows[name][row]).all()) for name in FLOATS]
        if not all(finite):  # a sum of millions of huge ones may overflow
            faults[row] = faults[row] or NOT_FINITE + finite.index(False)
    return faults
