"""The windows of ``common/window.py`` as the peers see them: what a learner reads of one, field by field.

B windows, T steps, O observation, A action, H hidden.
"""

from typing import NamedTuple

import numpy as np

STEPS = 25
Columns = dict[str, np.ndarray]


class Sizes(NamedTuple):
    """O, A and H."""

    observation: int
    action: int
    hidden: int


def random_columns(sizes: Sizes, count: int) -> Columns:
    """(B, ...) full windows of plausible numbers; ``marks`` is first, last, terminated."""
    rng = np.random.default_rng(0)
    shapes = {
        "observation": (STEPS + 1, sizes.observation),
        "action": (STEPS, sizes.action),
        "prev_action": (sizes.action,),
        "reward": (STEPS,),
        "hidden": (sizes.hidden,),
    }
    columns = {name: rng.uniform(-1.0, 1.0, (count, *shape)).astype(np.float32) for name, shape in shapes.items()}
    columns["missing"] = np.zeros((count, STEPS + 1), np.uint8)
    columns["marks"] = np.tile(np.array([0, STEPS, 0], np.int32), (count, 1))
    return columns


def pack(columns: Columns) -> Columns:
    """One column of bytes, a row a window."""
    count = len(columns["marks"])
    return {"row": np.concatenate([part.reshape(count, -1).view(np.uint8) for part in columns.values()], axis=1)}


def unpack(rows: np.ndarray, like: Columns) -> Columns:
    """The fields of (B, bytes) packed rows, as views."""
    columns, start = {}, 0
    for name, part in like.items():
        end = start + part[0].nbytes
        columns[name] = rows[:, start:end].view(part.dtype).reshape(len(rows), *part.shape[1:])
        start = end
    return columns
