"""The window: the one definition of what a sequence is, from actor to learner.

Shapes: T = burn_in + train steps; T + 1 observations; O observation, A action, S state (``AgentConfig.state_size``),
M flags of what is missing, P privileged numbers.

A window is a row of a structured dtype, laid out as ``[burn_in | train | 1 bootstrap]``. Two indices
say what is real: observations ``first <= t <= last`` and steps ``first <= t < last``. The last
observation (and the bootstrap one) is real but starts no step. Burn-in is all real or all padding, so
``first`` is either 0 or ``burn_in``; everything outside is zero. ``state`` is the recurrent state *before*
observation ``first``: the GRU's, and where missing frames are filled the last one, filled and normalised.
``prev_action`` is the action before it.

Integers are signed because torch views them in place (see ``learner/batch.py``).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROW_ALIGNMENT = 64  # bytes: a cache line, so that whole-row gathers run at memory speed
CHECKSUM_BYTES = 4

Rows = NDArray[np.void]
Slots = NDArray[np.int64]  # of a ring's rows
BoolArray = NDArray[np.bool_]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Field = tuple[str, str, tuple[int, ...]] | tuple[str, np.dtype[Any]]
HEADER_FIELDS: list[Field] = [
    ("serial", "<i8", ()),  # given by the ring; slot = serial mod capacity
    ("seq", "<i8", ()),  # origin: (actor, epoch, seq, k) names a window once and for all
    ("weights_update", "<i8", ()),  # the learner's update count of the weights that acted
    ("actor", "<i4", ()),
    ("epoch", "<i4", ()),
    ("k", "<i4", ()),  # place inside its stream entry
    ("env", "<i4", ()),  # which of the actor's environments
    ("episode_step", "<i4", ()),  # the first trained step, counted from its episode's start
    ("first", "<i4", ()),
    ("last", "<i4", ()),
    ("terminated", "<i4", ()),  # 1: step last - 1 ended in a true termination
    ("new_steps", "<i4", ()),  # trailing steps that no earlier window carried
    ("new_observations", "<i4", ()),  # trailing observations that no earlier window carried
    ("initial_priority", "<f4", ()),  # 0: enter with the largest priority that is there
]


@dataclass(frozen=True)
class WindowSpec:
    """Sizes of a window; two roles may talk only if their fingerprints agree."""

    obs_dim: int
    action_dim: int
    state: int
    burn_in: int = 10
    train: int = 15
    missing: int = 1
    """M: 1 flag for a whole frame, or O, one for each dimension of the observation."""
    privileged: int = 0
    """P, numbers beside an observation that critics alone read."""

    @property
    def steps(self) -> int:
        """T, the steps of a window: burn-in and trained."""
        return self.burn_in + self.train

    @property
    def observations(self) -> int:
        """T + 1: one more, the bootstrap observation."""
        return self.steps + 1

    @property
    def statistics(self) -> int:
        """O + P, numbers whose running statistics are kept."""
        return self.obs_dim + self.privileged

    @property
    def counts(self) -> int:
        """How many counts these statistics take: 1 where all numbers are there or missing together, else O + P."""
        return 1 if self.missing == 1 and not self.privileged else self.statistics

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The row's structured dtype, padded to 64 bytes; its last four are the checksum of all before."""
        return row_dtype(
            [
                *HEADER_FIELDS,
                ("observation", "<f4", (self.observations, self.obs_dim)),  # raw
                ("action", "<f4", (self.steps, self.action_dim)),  # in [-1, 1]
                ("prev_action", "<f4", (self.action_dim,)),
                ("reward", "<f4", (self.steps,)),  # extrinsic
                ("state", "<f4", (self.state,)),
                ("privileged", "<f4", (self.observations, self.privileged)),  # raw
                ("missing", "u1", (self.observations, self.missing)),  # 1: not seen
            ],
            checksum=True,
        )

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with the window's split and any field, shape or offset of the dtype."""
        return fingerprint(self, self.dtype)

    def trained_steps(self, rows: Rows) -> int:
        """Real trained steps in all rows, what a draw spends of the replay ratio."""
        return int((rows["last"] - self.burn_in).sum())


def joined(parts: Sequence[Rows], spec: WindowSpec) -> Rows:
    """All rows in one array; whole ones are copied, with their padding, not fields."""
    block = np.dtype((np.void, spec.dtype.itemsize))
    rows: Rows = np.concatenate([np.empty(0, block), *(part.view(block) for part in parts)]).view(spec.dtype)
    return rows


def row_dtype(fields: list[Field], checksum: bool) -> np.dtype[np.void]:
    """Fields side by side, padded to 64 bytes; the last four are the ``checksum``, given by the ring, if asked for."""
    packed = np.dtype(fields)
    assert packed.fields is not None
    used = packed.itemsize + CHECKSUM_BYTES * checksum
    itemsize = -(-used // ROW_ALIGNMENT) * ROW_ALIGNMENT
    names, formats = list(packed.names or ()), [field[0] for field in packed.fields.values()]
    offsets = [int(field[1]) for field in packed.fields.values()]
    if checksum:
        names, formats = [*names, "checksum"], [*formats, np.dtype("<u4")]
        offsets.append(itemsize - CHECKSUM_BYTES)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})


def fingerprint(spec: WindowSpec, dtype: np.dtype[np.void]) -> str:
    """Of windows that are split so, in rows of that dtype: 16 hexadecimal digits."""
    return hashlib.sha256(repr((spec.burn_in, spec.train, dtype)).encode()).hexdigest()[:16]
