"""An environment of which one instance can exist on this machine."""

import fcntl
import os

import gymnasium as gym

from tests.counting_env import CountingEnv


class OnlyOneEnv(CountingEnv):
    """Holds a lock, which RMC_TEST_LOCK names, for as long as it is there; it gives nothing back in ``close``."""

    def __init__(self) -> None:
        super().__init__(longest=40)
        self._lock = os.open(os.environ["RMC_TEST_LOCK"], os.O_WRONLY | os.O_CREAT)
        fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def __del__(self) -> None:
        os.close(self._lock)


gym.register("OnlyOne-v0", OnlyOneEnv)
