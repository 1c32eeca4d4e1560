"""An environment of which one instance can exist on this machine."""

import fcntl
import os
from typing import Any

import gymnasium as gym
import numpy as np

from tests.counting_env import CountingEnv


class OnlyOneEnv(CountingEnv):
    """Holds a lock, which RMC_TEST_LOCK names, for as long as it is there; it gives nothing back in ``close``.

    It may break in each episode's fifth step, or in each reset without a seed but the first.
    """

    def __init__(self, breaks_in: str = "") -> None:
        super().__init__(longest=40)
        self._breaks_in = breaks_in
        self._lock = os.open(os.environ["RMC_TEST_LOCK"], os.O_WRONLY | os.O_CREAT)
        fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        result = super().reset(**options)
        if self._breaks_in == "reset" and self._episode:
            raise RuntimeError("the simulation is unstable")
        return result

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        if self._breaks_in == "step" and self._step == 5:
            raise RuntimeError("the simulation is unstable")
        return result

    def __del__(self) -> None:
        os.close(self._lock)


gym.register("OnlyOne-v0", OnlyOneEnv)
