"""Environments that break, each in its own way, in every third episode."""

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tests.counting_env import CountingEnv

BREAKS_AT = 7  # step of an episode that is long enough; a shorter one is sound
FAULTS = ("raise", "nan", "inf", "shape", "scalar", "reward", "text")


class BrokenEnv(CountingEnv):
    """Counts as CountingEnv does, until it breaks; what it gave before is sound."""

    def __init__(self, fault: str = "raise", at: int = BREAKS_AT) -> None:
        super().__init__()
        self._fault, self._at = fault, at

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if self._episode % 3 != 2 or self._step != self._at:
            return observation, reward, terminated, truncated, info
        return self._broken(observation), np.nan if self._fault == "reward" else reward, True, truncated, info

    def _broken(self, observation: np.ndarray) -> Any:
        if self._fault == "raise":
            raise RuntimeError("the simulation is unstable")
        if self._fault in ("nan", "inf"):
            observation[1] = float(self._fault)
        odd = {"shape": observation[:-1], "scalar": np.float32(1.0), "text": ["a"] * len(observation)}
        return odd.get(self._fault, observation)


class HangingEnv(BrokenEnv):
    """Also hangs, once: the file that RMC_TEST_HANG names is there afterwards."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        mark = Path(os.environ["RMC_TEST_HANG"])
        if self._episode == 3 and not mark.exists():
            mark.touch()
            time.sleep(600)
        return super().step(action)


class EarlyEnv(CountingEnv):
    """Breaks in the third step of each of its episodes."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._length = 5
        observation, reward, *_, info = super().step(action)
        if self._step == 3:
            raise RuntimeError("the simulation is unstable")
        return observation, reward, False, False, info


for _fault in FAULTS:
    gym.register(f"Broken-{_fault}-v0", entry_point=BrokenEnv, kwargs={"fault": _fault})
gym.register("Early-v0", entry_point=EarlyEnv)
gym.register("Hanging-v0", entry_point=HangingEnv)
