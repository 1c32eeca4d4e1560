"""An environment that takes its time: a robot, or a simulator elsewhere."""

import time
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

STEP_SECONDS = 0.01
Array = NDArray[np.float32]


class Slow(gym.Env[Array, Array]):
    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        time.sleep(STEP_SECONDS)
        return self._seen(), 1.0, False, False, {}

    def _seen(self) -> Array:
        return self.np_random.uniform(-1.0, 1.0, 3).astype(np.float32)


gym.register("Slow-v0", Slow, max_episode_steps=50)
