"""The evaluator: plays whole episodes with the policy's mean, without exploring.

Shapes: N episodes played side by side, O observation, A action, H hidden.
"""

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from actors.policy_runner import PolicyRunner
from common.agent import AgentConfig
from common.bus import Bus, Version
from common.envs import Env
from common.errors import BusFull, BusUnavailable, ConfigError

POLL_SECONDS = 0.1  # between looks for a policy to play
LONGEST_EPISODE = 10_000  # steps, where the environment has no time limit: an episode need not end by itself


@dataclass(frozen=True)
class EvaluatorConfig:
    """How a policy is judged."""

    episodes: int = 5
    """Episodes per evaluation, played side by side with the policy's mean."""


class Match:
    """The first episode of each of N environments, played to its end; those that ended stand still.

    Without a time limit, an episode's first 10 000 steps are what counts.
    """

    def __init__(self, runner: PolicyRunner, envs: Sequence[Env], seed: int) -> None:
        """``runner`` is for N environments. The i-th one is reset with seed + i."""
        self._runner, self._envs = runner, envs
        starts = [env.reset(seed=seed + i) for i, env in enumerate(envs)]
        self._observation = np.stack([observation for observation, _ in starts])
        self._blank = np.array([bool(info.get("blank", False)) for _, info in starts])
        self._prev_action, self._hidden = runner.start()
        self._playing = np.ones(len(envs), np.bool_)
        self.returns = np.zeros(len(envs))
        self.steps = self._rounds = 0
        limited = all(env.spec is not None and env.spec.max_episode_steps is not None for env in envs)
        self._longest = sys.maxsize if limited else LONGEST_EPISODE

    def step(self) -> bool:
        """One step of every episode that goes on; whether any does."""
        self._rounds += 1
        action, hidden = self._runner.act(self._observation, self._prev_action, self._blank, self._hidden, None)
        self._prev_action, self._hidden[:] = action, hidden
        for i in np.flatnonzero(self._playing).tolist():
            self._observation[i], reward, terminated, truncated, info = self._envs[i].step(action[i])
            self._blank[i] = info.get("blank", False)
            self.returns[i] += reward
            self.steps += 1
            self._playing[i] = not (terminated or truncated or self._rounds >= self._longest)
        return bool(self._playing.any())


def play_episodes(runner: PolicyRunner, make_env: Callable[[], Env], episodes: int, seed: int) -> list[float]:
    """Returns of so many deterministic episodes, played as one batch; ``runner`` is for as many environments."""
    envs = [make_env() for _ in range(episodes)]
    try:
        match = Match(runner, envs, seed)
        while match.step():
            pass
    finally:
        for env in envs:
            env.close()
    return [float(value) for value in match.returns]


class Evaluator:
    """A role: plays every policy that the learner asks to have played, the newest first.

    One ``step`` is one step of all its episodes. Every evaluation starts from the same seeds, so that two
    policies are compared on the same starts.
    """

    name = "evaluator"

    def __init__(
        self,
        seed: int,
        make_env: Callable[[], Env],
        agent: AgentConfig,
        config: EvaluatorConfig,
        bus: Bus,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``clock`` times the looks for new policies."""
        if config.episodes < 1:
            raise ConfigError("--episodes", config.episodes, "at least 1")
        self._seed, self._bus, self._clock = seed, bus, clock
        self._envs = [make_env() for _ in range(config.episodes)]
        observation, action = self._envs[0].observation_space.shape, self._envs[0].action_space.shape
        assert observation
        assert action
        self._runner = PolicyRunner(observation[0], action[0], agent, config.episodes)
        self._version = Version(0, -1)  # none yet
        self._match: Match | None = None
        self._next_look = float("-inf")
        self._records: deque[dict[str, Any]] = deque()

    def step(self) -> bool:
        """One step of the running evaluation, or a look for a new policy; False where there is none."""
        if self._match is None:
            self._match = self._begin()
        if self._match is None:
            return False
        if not self._match.step():
            self._records.append(_record(self._match, self._version))
            self._match = None
        return True

    def _begin(self) -> Match | None:
        if self._clock() < self._next_look:
            return None
        self._next_look = self._clock() + POLL_SECONDS
        newest = self._bus.latest_version(evaluate=True)
        found = self._bus.weights(evaluate=True) if newest not in (None, self._version) else None
        if found is None:
            return None
        self._version, blob = found
        self._runner.load(blob)
        return Match(self._runner, self._envs, self._seed)

    def waiting_for(self) -> str:
        return "a policy to evaluate"

    def metrics(self) -> dict[str, Any]:
        """The oldest evaluation not handed out yet, once; empty if there is none."""
        return self._records.popleft() if self._records else {}

    def close(self) -> None:
        """Hand out what is left, and close the environments."""
        with suppress(BusUnavailable, BusFull):
            while self._records:
                self._bus.emit(self.name, {"time": time.time(), **self._records[0]})
                self._records.popleft()
        for env in self._envs:
            env.close()


def _record(match: Match, version: Version) -> dict[str, Any]:
    return {
        "eval_return_mean": float(match.returns.mean()),
        "eval_return_std": float(match.returns.std()),
        "eval_episodes": len(match.returns),
        "eval_steps": match.steps,
        "eval_update": version.update,
    }
