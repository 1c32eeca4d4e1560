"""Environments of odd spaces; in most the agent cannot learn."""

from typing import Any

import gymnasium as gym
import numpy as np


class Odd(gym.Env[Any, Any]):
    """Never stepped: its spaces are refused first."""

    def __init__(self, observation: gym.Space[Any], action: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action


class Column(gym.Env[Any, Any]):
    """It can be learnt in: a vector that stands upright, or lies."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, shape: tuple[int, int] = (2, 1)) -> None:
        self.observation_space = gym.spaces.Box(-1.0, 1.0, shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(self.observation_space.shape or (), np.float32), {}


_VECTOR = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
_IMAGE = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
_UNBOUNDED = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
gym.register("OddImage-v0", lambda: Odd(_IMAGE, _VECTOR))
gym.register("OddUnbounded-v0", lambda: Odd(_VECTOR, _UNBOUNDED))
gym.register("Column-v0", lambda: Column())
gym.register("Row-v0", lambda: Column((1, 2)))
