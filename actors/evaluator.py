"""The evaluator: plays whole episodes with the policy's mean, without exploring.

Shapes: N episodes played side by side, O observation, A action, S state.
"""

import logging
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rmc.actors.config import EvaluatorConfig
from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.protocol import Bus, Version
from rmc.common.env.make import checked_reset, recreate_env
from rmc.common.env.wrappers import Env, Floats
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, EnvFault, MessageError

log = logging.getLogger(__name__)
POLL_SECONDS = 0.1  # between looks for a policy to play
LONGEST_EPISODE = 10_000  # steps, where the environment has no time limit: an episode need not end by itself


def first_start(run_seed: int, final: bool = False) -> int:
    """Seed of the first episode of an evaluation, those after it count on from there.

    A run's last evaluation, and ``rmc evaluate``, start elsewhere than those that tell which checkpoint is the best.
    """
    return int(np.random.SeedSequence([run_seed, final]).generate_state(1)[0]) >> 1  # leaves room for those after it


class PolicyLike(Protocol):
    """What plays: a ``PolicyRunner``, or another agent that acts like one."""

    def start(self) -> tuple[Floats, Floats]:
        """Previous action (N, A) and state (N, S) at the start of episodes."""

    def act(
        self,
        observation: Floats,
        prev_action: Floats,
        missing: NDArray[np.bool_],
        state: Floats,
        noise: Floats | None,
        /,
    ) -> tuple[Floats, Floats]:
        """(N, O), (N, A), (N,), (N, S), and noise or None for the mean -> (N, A) in [-1, 1], (N, S)."""


class Rollout:
    """The first episode of each of N environments, played to its end; those that ended stand still.

    Without a time limit, an episode's first 10 000 steps are what counts.
    """

    def __init__(self, runner: PolicyLike, envs: Sequence[Env], seed: int) -> None:
        """``runner`` is for N environments. The i-th one is reset with seed + i."""
        self._runner, self._envs = runner, envs
        shape = envs[0].observation_space.shape
        self._observation = np.zeros((len(envs), *(shape or ())), np.float32)
        self._prev_action, self._state = runner.start()
        self._playing = np.ones(len(envs), np.bool_)
        self._missing, self.broken = np.zeros((2, len(envs)), np.bool_)
        self.fault: Exception | None = None  # what an environment broke in last
        self._returns = np.zeros(len(envs))
        self.steps = self._rounds = 0
        for i in range(len(envs)):
            self._guarded(i, self._reset, seed + i)
        limited = all(env.spec is not None and env.spec.max_episode_steps is not None for env in envs)
        self._longest = sys.maxsize if limited else LONGEST_EPISODE

    def step(self) -> bool:
        """One step of every episode that goes on; whether any does."""
        self._rounds += 1
        action, state = self._runner.act(self._observation, self._prev_action, self._missing, self._state, None)
        self._prev_action, self._state[:] = action, state
        for i in np.flatnonzero(self._playing).tolist():
            self._guarded(i, self._step_environment, action[i])
        return bool(self._playing.any())

    def _guarded(self, i: int, action: Callable[[int, Any], None], argument: Any) -> None:
        """What an environment breaks in ends its episode, which then counts for nothing."""
        try:
            action(i, argument)
        except Exception as error:
            if str(error) != str(self.fault):  # once, however many break alike
                log.warning("environment %d of an evaluation broke: %s", i, error)
            self.fault = error
            self._playing[i], self.broken[i] = False, True
            self._observation[i] = 0.0

    def _reset(self, i: int, seed: int) -> None:
        self._observation[i], info = checked_reset(self._envs[i], seed)
        self._missing[i] = info.get("missing", False)

    def _step_environment(self, i: int, action: Floats) -> None:
        self._observation[i], reward, terminated, truncated, info = self._envs[i].step(action)
        if not (np.isfinite(self._observation[i]).all() and math.isfinite(reward)):
            raise EnvFault("the environment's observation or reward is not finite")
        self._missing[i] = info.get("missing", False)
        self._returns[i] += float(reward)
        self.steps += 1
        self._playing[i] = not (terminated or truncated or self._rounds >= self._longest)

    @property
    def returns(self) -> NDArray[np.float64]:
        """Of the episodes in which the environment did not break."""
        return self._returns[~self.broken]


def play_episodes(runner: PolicyLike, make_env: Callable[[], Env], episodes: int, seed: int) -> list[float]:
    """Returns of so many deterministic episodes, played as one batch; ``runner`` is for as many environments.

    Those in which the environment broke are left out. Raises EnvFault where none is left.
    """
    envs = [make_env() for _ in range(episodes)]
    try:
        match = Rollout(runner, envs, seed)
        while match.step():
            pass
    finally:
        for env in envs:
            env.close()
    if not match.returns.size:
        raise EnvFault(f"the environment broke in each of {episodes} episodes: {match.fault}")
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
        """``seed`` is the run's; ``clock`` times the looks for new policies."""
        if config.episodes < 1:
            raise ConfigError("--episodes", config.episodes, "at least 1")
        self._seed, self._bus, self._clock = first_start(seed), bus, clock
        self._make_env, self._envs = make_env, [make_env() for _ in range(config.episodes)]
        observation, action = self._envs[0].observation_space.shape, self._envs[0].action_space.shape
        assert observation
        assert action
        self._runner = PolicyRunner(observation[0], action[0], agent, config.episodes)
        self._version = Version(0, -1)  # the newest that was looked at: none yet
        self._refused_weights = 0
        self._match: Rollout | None = None
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
            for i in np.flatnonzero(self._match.broken).tolist():
                self._envs[i] = recreate_env(self._envs[i], self._make_env)
            self._match = None
        return True

    def _begin(self) -> Rollout | None:
        if self._clock() < self._next_look:
            return None
        self._next_look = self._clock() + POLL_SECONDS
        newest = self._bus.latest_version(evaluate=True)
        found = self._bus.weights(evaluate=True) if newest not in (None, self._version) else None
        if found is None:
            return None
        self._version, blob = found
        return Rollout(self._runner, self._envs, self._seed) if self._load(blob) else None

    def _load(self, blob: bytes) -> bool:
        """Whether it is a policy; what cannot be read is refused, and the next one is waited for."""
        try:
            self._runner.load(blob)
        except MessageError as error:
            self._refused_weights += 1
            self._records.append({"refused_weights": self._refused_weights})
            log.warning("%s: refused %s: %s", self.name, self._version, error)
            return False
        return True

    def waiting_for(self) -> str:
        return "a policy to evaluate"

    def metrics(self) -> dict[str, Any]:
        """The oldest evaluation or refusal not handed out yet, once; empty if there is none."""
        return self._records.popleft() if self._records else {}

    def close(self) -> None:
        """Hand out what is left, and close the environments."""
        with suppress(BusUnavailable, BusFull):
            while self._records:
                self._bus.emit(self.name, {"time": time.time(), **self._records[0]})
                self._records.popleft()
        for env in self._envs:
            env.close()


def _record(match: Rollout, version: Version) -> dict[str, Any]:
    broken = {"eval_broken_episodes": int(match.broken.sum())}
    if not match.returns.size:
        return broken
    return broken | {
        "eval_return_mean": float(match.returns.mean()),
        "eval_return_std": float(match.returns.std()),
        "eval_episodes": len(match.returns),
        "eval_steps": match.steps,
        "eval_update": version.update,
    }
