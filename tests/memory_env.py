"""A task that nobody solves without a memory: a cue at the first step, asked for after a delay.

Observations are (cue at the first step, else 0; 1 while the answer is asked for). In the answer phase a
step's reward is cue x action. The cue is +1 or -1 with equal chance, so a policy that sees only the newest
observation has an expected return of 0 at best; one that remembers reaches ``ANSWER_STEPS``. ``info["probe"]`` has it.
"""

from typing import Any

import gymnasium as gym
import numpy as np

ANSWER_STEPS = 4
SOLVED_RETURN = 0.9 * ANSWER_STEPS


class MemoryEnv(gym.Env[np.ndarray, np.ndarray]):
    """Episodes of ``delay`` + ``ANSWER_STEPS`` steps, which end in a termination."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, delay: int) -> None:
        self._delay, self._cue, self._step = delay, 1.0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._cue = 1.0 if self.np_random.random() < 0.5 else -1.0
        self._step = 0
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = self._cue * float(action[0]) if self._asked() else 0.0
        self._step += 1
        return self._observation(), reward, self._step == self._delay + ANSWER_STEPS, False, self._info()

    def _info(self) -> dict[str, Any]:
        return {"probe": {"cue": self._cue}}

    def _asked(self) -> bool:
        return self._step >= self._delay

    def _observation(self) -> np.ndarray:
        return np.array([self._cue if self._step == 0 else 0.0, float(self._asked())], np.float32)


gym.register("Memory12-v0", entry_point="tests.memory_env:MemoryEnv", kwargs={"delay": 12})
gym.register("Memory40-v0", entry_point="tests.memory_env:MemoryEnv", kwargs={"delay": 40})
