"""Steps a second of stable-baselines3's SAC collecting: ``predict``, then ``env.step`` of a DummyVecEnv.

    python sb3_actor.py ENV ENVS

Answers each line, the seconds to measure for. It has the thread count that was fastest at the start.
"""

import os
import sys

import gymnasium as gym
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv
from turns import speed, take_turns

TRIAL_SECONDS = 2.0


class Collector:
    """A policy as large as ours, and its environments."""

    def __init__(self, env_id: str, envs: int) -> None:
        self._env = DummyVecEnv([lambda: gym.make(env_id) for _ in range(envs)])
        self._model = SAC(
            "MlpPolicy", self._env, policy_kwargs={"net_arch": [400, 300]}, buffer_size=1000, device="cpu"
        )
        self._observation = self._env.reset()
        self._envs = envs

    def speed(self, seconds: float) -> float:
        """Environment steps a second."""
        return speed(self._step, seconds)

    def _step(self) -> int:
        action, _ = self._model.predict(self._observation, deterministic=False)
        self._observation, *_ = self._env.step(action)
        return self._envs

    def with_threads(self, threads: int) -> float:
        """The speed with so many."""
        torch.set_num_threads(threads)
        return self.speed(TRIAL_SECONDS)


def main() -> None:
    collector = Collector(sys.argv[1], int(sys.argv[2]))
    torch.set_num_threads(max(range(1, (os.cpu_count() or 1) + 1), key=collector.with_threads))
    take_turns(collector.speed)


if __name__ == "__main__":
    main()
