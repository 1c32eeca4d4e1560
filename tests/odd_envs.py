"""Environments whose observations are no plain vector."""

from typing import Any

import gymnasium as gym
import numpy as np


class Column(gym.Env[Any, Any]):
    """A vector that stands upright, or lies."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, shape: tuple[int, int] = (2, 1)) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(self.observation_space.shape or (), np.float32), {}


gym.register("Column-v0", lambda: Column())
gym.register("Row-v0", lambda: Column((1, 2)))
