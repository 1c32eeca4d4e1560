"""An environment that starts a process, which tells what it has inherited."""

import os
import subprocess
from pathlib import Path

import gymnasium as gym

from tests.counting_env import CountingEnv

TELLS = "RMC_TEST_TOLD"  # names the folder that is told in, a file for each process that plays


class Telling(CountingEnv):
    """Tells it when it is made."""

    def __init__(self) -> None:
        super().__init__()
        with (Path(os.environ[TELLS]) / str(os.getpid())).open("wb") as file:
            subprocess.run(["env"], stdout=file, check=True)


gym.register("Telling-v0", Telling)
