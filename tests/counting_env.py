"""An environment that counts, and the audit of what became of its counts.

An observation is (seed's upper 16 bits, its lower 15 bits, episode, step): the seed given at the last
seeded reset names the environment, as no two of a run share one. The reward of a step is its number + 1.
"""

from collections import Counter
from itertools import pairwise
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rmc.common.window import Rows, WindowSpec

LONGEST = 40
OBS_DIM, ACTION_DIM = 4, 2


class CountingEnv(gym.Env[np.ndarray, np.ndarray]):
    """Episodes of 1 to ``longest`` steps that end by termination or truncation, at random."""

    observation_space = gym.spaces.Box(0.0, np.inf, (OBS_DIM,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    def __init__(self, longest: int = LONGEST) -> None:
        self._longest = longest
        self._name, self._episode, self._step, self._length = 0, -1, 0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self._name, self._episode = seed, -1
        self._episode += 1
        self._step = 0
        self._length = int(self.np_random.integers(1, self._longest + 1))
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self._step < self._length, "stepped past the end"
        self._step += 1
        ended = self._step == self._length
        terminated = ended and self._length % 2 == 0
        return self._observation(), float(self._step), terminated, ended and not terminated, {}

    def _observation(self) -> np.ndarray:
        return np.array([self._name >> 15, self._name & 0x7FFF, self._episode, self._step], np.float32)


class Step(NamedTuple):
    """A step's name: which environment, which of its episodes, which step."""

    env: int
    episode: int
    step: int


class Audit(NamedTuple):
    """What rows hold. ``trained`` counts how often each step stands in a trained slot, in order of arrival."""

    trained: Counter[Step]
    new_steps: int
    terminated: set[Step]  # last steps of episodes that ended in a termination


def audit(rows: Rows, spec: WindowSpec) -> Audit:
    """Assert that every window runs step by step through one episode, and count what it trains."""
    trained: Counter[Step] = Counter()
    terminated: set[Step] = set()
    for row in rows:
        first, last = int(row["first"]), int(row["last"])
        seen = [_name(observation) for observation in row["observation"][first : last + 1]]
        for before, after in pairwise(seen):
            assert after == before._replace(step=before.step + 1), (before, after)
        assert row["reward"][first:last].tolist() == [name.step for name in seen[1:]]
        trained.update(seen[spec.burn_in - first : -1])
        if row["terminated"]:
            assert seen[-1].step % 2 == 0
            terminated.add(seen[-2])
    return Audit(trained, int(rows["new_steps"].sum()), terminated)


def _name(observation: np.ndarray) -> Step:
    high, low, episode, step = (int(value) for value in observation)
    return Step(high << 15 | low, episode, step)


gym.register("Counting-v0", entry_point="tests.counting_env:CountingEnv")
