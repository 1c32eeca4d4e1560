"""A pendulum with simulators of its own, which its close ends: in its group, in a session, and as a daemon."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

SIMULATE = [sys.executable, "-S", "-c", "import time; time.sleep(3600)"]
SPAWNED = "RMC_TEST_SPAWNED"  # the folder that tells which process started which


class Spawning(InvertedPendulumEnv):
    """Hangs in its step where its process is told to by a file."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.simulators = [
            subprocess.Popen(SIMULATE).pid,
            subprocess.Popen(SIMULATE, start_new_session=True).pid,
            _daemon(),
        ]
        with (Path(os.environ[SPAWNED]) / str(os.getpid())).open("a") as file:
            file.write("".join(f"{pid}\n" for pid in self.simulators))

    def step(self, action: Any) -> Any:
        while (Path(os.environ[SPAWNED]) / f"hang-{os.getpid()}").exists():
            pass
        return super().step(action)

    def close(self) -> None:
        super().close()
        while self.simulators:
            with suppress(ProcessLookupError):
                os.kill(self.simulators.pop(), signal.SIGKILL)


def _daemon() -> int:
    command = f"import subprocess; print(subprocess.Popen({SIMULATE!r}, start_new_session=True, stdout=-3).pid)"
    return int(subprocess.run([sys.executable, "-S", "-c", command], stdout=subprocess.PIPE, check=True).stdout)


gymnasium.register("Spawning-v0", Spawning, max_episode_steps=100)
