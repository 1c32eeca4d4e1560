"""The window: the one definition of what a sequence is, from actor to learner.

Shapes: T = burn_in + train steps; T + 1 observations; O observation, A action, S state (``AgentConfig.state_size``).

A window is a row of a structured dtype, laid out as ``[burn_in | train | 1 bootstrap]``. Two indices
say what is real: observations ``first <= t <= last`` and steps ``first <= t < last``. The last
observation (and the bootstrap one) is real but starts no step. Burn-in is all real or all padding, so
``first`` is either 0 or ``burn_in``; everything outside is zero. ``state`` is the recurrent state *before*
observation ``first``: the GRU's, and where missing frames are filled what was last seen, normalised. ``prev_action`` is
the action before it.

Integers are signed because torch views them in place (see ``learner/batch.py``).
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

ROW_ALIGNMENT = 64  # bytes: a cache line, so that whole-row gathers run at memory speed

Rows = NDArray[np.void]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class WindowSpec:
    """Sizes of a window; two roles may talk only if their fingerprints agree."""

    obs_dim: int
    action_dim: int
    state: int
    burn_in: int = 10
    train: int = 15

    @property
    def steps(self) -> int:
        """T, the steps of a window: burn-in and trained."""
        return self.burn_in + self.train

    @property
    def observations(self) -> int:
        """T + 1: one more, the bootstrap observation."""
        return self.steps + 1

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The row's structured dtype, padded to 64 bytes."""
        return self._row("missing")

    def _row(self, missing: str) -> np.dtype[np.void]:
        """Of rows whose last field is called so."""
        fields: list[tuple[str, str, tuple[int, ...]]] = [
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
            ("initial_priority", "<f4", ()),  # 0: enter with the largest priority seen
            ("observation", "<f4", (self.observations, self.obs_dim)),  # raw
            ("action", "<f4", (self.steps, self.action_dim)),  # in [-1, 1]
            ("prev_action", "<f4", (self.action_dim,)),
            ("reward", "<f4", (self.steps,)),  # extrinsic
            ("state", "<f4", (self.state,)),
            (missing, "u1", (self.observations,)),  # 1: a flickered-out frame
        ]
        packed = np.dtype(fields)
        itemsize = -(-packed.itemsize // ROW_ALIGNMENT) * ROW_ALIGNMENT
        names = list(packed.names or ())
        offsets = [int(packed.fields[name][1]) for name in names] if packed.fields else []
        formats = [packed.fields[name][0] for name in names] if packed.fields else []
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with the window's split and any field, shape or offset of the dtype."""
        return self._digest(self.dtype)

    @cached_property
    def former_fingerprint(self) -> str:
        """The fingerprint in the rings of config format 1, where ``missing`` was called ``blank``: the same bytes."""
        return self._digest(self._row("blank"))

    def _digest(self, dtype: np.dtype[np.void]) -> str:
        return hashlib.sha256(repr((self.burn_in, self.train, dtype)).encode()).hexdigest()[:16]

    def trained_steps(self, rows: Rows) -> int:
        """Real trained steps in all rows, what a draw spends of the replay ratio."""
        return int((rows["last"] - self.burn_in).sum())
