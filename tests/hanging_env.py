"""An environment that hangs where RMC_TEST_HANGS says: import, make, reset, step or close."""

import os
import time
from typing import Any

import gymnasium as gym
import numpy as np

from tests.counting_env import CountingEnv


def hang(place: str) -> None:
    if os.environ.get("RMC_TEST_HANGS") == place:
        time.sleep(600)


class HangingEnv(CountingEnv):
    """Counts as CountingEnv does, where it does not hang."""

    def __init__(self) -> None:
        super().__init__()
        hang("make")

    def reset(self, **given: Any) -> tuple[np.ndarray, dict[str, Any]]:
        hang("reset")
        return super().reset(**given)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        hang("step")
        return super().step(action)

    def close(self) -> None:
        hang("close")


hang("import")
gym.register("HangsAsTold-v0", HangingEnv)
