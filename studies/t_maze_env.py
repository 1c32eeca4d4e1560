"""The passive T-maze: a cue at the first step decides which way is right at the end of a corridor.

The agent moves by itself. Observations are (cue at the first step, else 0; 1 at the junction, else 0). The action's
sign at the junction is the way: +1 where it is the cue's, -1 where it is not; then the episode ends. A policy that sees
only the newest observation has an expected return of 0; one that remembers makes 1.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

LENGTHS = (10, 50, 100, 250)
Floats = NDArray[np.float32]


class TMaze(gym.Env[Floats, Floats]):
    """Episodes of ``length`` + 1 steps, which end in a termination."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int) -> None:
        self._length, self._cue, self._place = length, 1.0, 0

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002 (gymnasium asks for it)
    ) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        self._cue = 1.0 if self.np_random.random() < 0.5 else -1.0
        self._place = 0
        return self._observation(), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        if self._place == self._length:
            return self._observation(), 1.0 if action[0] * self._cue > 0.0 else -1.0, True, False, {}
        self._place += 1
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> Floats:
        return np.array([self._cue if self._place == 0 else 0.0, float(self._place == self._length)], np.float32)


for length in LENGTHS:
    gym.register(
        f"TMaze{length}-v0",
        entry_point="studies.t_maze_env:TMaze",
        kwargs={"length": length},
        max_episode_steps=length + 1,
    )
