"""Environments that the agent cannot learn in."""

from typing import Any

import gymnasium as gym
import numpy as np


class Odd(gym.Env[Any, Any]):
    """Never stepped: its spaces are refused first."""

    def __init__(self, observation: gym.Space[Any], action: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action


_VECTOR = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
_IMAGE = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
_UNBOUNDED = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
gym.register("OddImage-v0", lambda: Odd(_IMAGE, _VECTOR))
gym.register("OddUnbounded-v0", lambda: Odd(_VECTOR, _UNBOUNDED))
