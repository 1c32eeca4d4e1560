"""An environment that is seen in part: by number, and with what critics alone may read."""

from typing import Any

import gymnasium as gym
import numpy as np

STEPS, OBS_DIM, HIDDEN_DIM = 20, 3, 2


class Partial(gym.Env[Any, Any]):
    """A point pushed to 0. Observation: place, speed, noise; ``missing``: by "number", "frame", or "" for never."""

    observation_space = gym.spaces.Box(-99.0, 99.0, (OBS_DIM,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, missing: str = "number", privileged: bool = True) -> None:
        self._missing, self._privileged = missing, privileged

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.speed = float(self.np_random.uniform(-2, 2)), 0.0
        return self._seen()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.speed += 0.1 * float(action[0])
        self.place += 0.1 * self.speed
        observation, info = self._seen()
        return observation, -abs(self.place), False, False, info

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        observation = np.array([self.place, self.speed, self.np_random.normal()], np.float32)
        info: dict[str, Any] = {"privileged": [self.place, 10.0 * self.speed]} if self._privileged else {}
        if self._missing:
            info["missing"] = self.np_random.random(OBS_DIM if self._missing == "number" else None) < 0.3
            observation = np.where(info["missing"], 0.0, observation)
        return observation, info


gym.register("Partial-v0", entry_point=Partial, max_episode_steps=STEPS)
