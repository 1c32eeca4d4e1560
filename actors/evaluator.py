"""The evaluator: plays whole episodes with the policy's mean, without exploring.

Shapes: N environments, here always one, O observation, A action, S state, M flags of what is missing.
"""

import logging
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from rmc.actors.config import EvaluatorConfig
from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.protocol import Bus, Version
from rmc.common.env.make import further_env, recreate_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, EnvFault, MessageError
from rmc.common.window import BoolArray, Floats

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
        missing: BoolArray,
        state: Floats,
        noise: Floats | None,
        /,
    ) -> tuple[Floats, Floats]:
        """(N, O), (N, A), (N, M), (N, S), and noise or None for the mean -> (N, A) in [-1, 1], (N, S)."""


def longest_episode(env: Env) -> int:
    """Steps after which an episode that has not ended is given up: none, where the environment has a limit."""
    limited = env.spec is not None and env.spec.max_episode_steps is not None
    return sys.maxsize if limited else LONGEST_EPISODE


class Rollout:
    """Deterministic episodes of one environment, one after the other: how many there are changes none of them.

    Without a time limit, an episode's first 10 000 steps are what counts. One in which the environment breaks counts
    for nothing. After ``seconds`` (0: never) no more is played; the first episode then counts as far as it came.
    """

    def __init__(
        self,
        runner: PolicyLike,
        env: Env,
        make_env: Callable[[], Env],
        episodes: int,
        seed: int,
        seconds: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``env`` is replaced where it breaks. Episode k is reset with seed + k."""
        self._runner, self.env, self._make_env, self._clock = runner, env, make_env, clock
        self._seed, self.episodes = seed, episodes
        self._deadline = clock() + seconds if seconds else math.inf
        self._longest = longest_episode(env)
        self.returns: list[float] = []  # of the episodes that are over
        self.broken = self.steps = 0
        self.fault: Exception | None = None  # what an environment broke in last
        self.cut = False
        self.keeps = self.stopped = False  # whether an interrupt ends it as ``seconds`` do, and did
        self._prev_action, self._state = runner.start()
        self._length = -1  # of the episode; it has not begun

    @property
    def episode(self) -> int:
        """Which one is played, from 0 on."""
        return len(self.returns) + self.broken

    def step(self) -> bool:
        """One reset or step; whether there is more to play."""
        if self._length >= 0:
            action, state = self._runner.act(self._observation, self._prev_action, self._missing, self._state, None)
            self._prev_action, self._state[:] = action, state
        try:
            over = self._begin() if self._length < 0 else self._step_environment(self._prev_action[0])
        except Exception as error:
            if str(error) != str(self.fault):  # once, however many break alike
                log.warning("episode %d of an evaluation broke: %s", self.episode, error)
            self.fault = error
            self.broken, self._length = self.broken + 1, -1
            self.env = recreate_env(self.env, self._make_env, error)
            over = False
        self._judge(over)
        return self.episode < self.episodes and not self.cut

    def _begin(self) -> bool:
        observation, info = self.env.reset(seed=self._seed + self.episode)
        self._prev_action, self._state = self._runner.start()
        self._see(observation, info)
        self._length, self._return = 0, 0.0
        return False

    def _step_environment(self, action: Floats) -> bool:
        """Whether the episode is over."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not math.isfinite(reward):
            raise EnvFault("the environment's reward is not finite")
        self._see(observation, info)
        self._return += float(reward)
        self.steps += 1
        self._length += 1
        return bool(terminated or truncated or self._length >= self._longest)

    def _see(self, observation: Floats, info: dict[str, Any]) -> None:
        self._observation, self._missing = observation[None], np.atleast_2d(info.get("missing", False))

    def _judge(self, over: bool) -> None:
        late = self._clock() >= self._deadline
        self.cut = late and not over and (self._length > 0 or bool(self.returns))
        if over or (self.cut and not self.returns):
            self.returns.append(self._return)
            self._length = -1


def play_episodes(
    runner: PolicyLike,
    make_env: Callable[[], Env],
    episodes: int,
    seed: int,
    seconds: float = 0.0,
    watch: Callable[[Rollout], None] = lambda _: None,
) -> Rollout:
    """So many deterministic episodes, as a ``Rollout``, which ``watch`` sees after each step.

    Those in which the environment broke are left out. Raises EnvFault where none is left, KeyboardInterrupt where
    it is interrupted and does not keep what is over, or nothing is.
    """
    rollout = Rollout(runner, make_env(), make_env, episodes, seed, seconds)
    try:
        while rollout.step():
            watch(rollout)
    except KeyboardInterrupt:
        if not (rollout.keeps and rollout.returns):
            raise
        rollout.stopped = rollout.cut = True
    finally:
        rollout.env.close()
    if not rollout.returns:
        raise EnvFault(f"the environment broke in each of {rollout.broken} episodes: {rollout.fault}")
    return rollout


class Evaluator:
    """A role: plays the newest policy that the learner asks to have played, whenever it is free.

    One ``step`` is one of an episode's. Every evaluation starts from the same seeds, so that two policies are
    compared on the same starts.
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
        missing: int = 1,
    ) -> None:
        """``seed`` is the run's; ``clock`` times the looks for new policies; ``missing`` is M."""
        if config.episodes < 1:
            raise ConfigError("--episodes", config.episodes, "at least 1")
        self._seed, self._bus, self._clock, self._config = first_start(seed), bus, clock, config
        self._make_env, self._env = make_env, further_env(make_env, "the evaluator's environment")
        observation, action = self._env.observation_space.shape, self._env.action_space.shape
        assert observation
        assert action
        self._runner = PolicyRunner(observation[0], action[0], agent, 1, missing)
        self._version = Version(0, -1)  # the newest that was looked at: none yet
        self._refused_weights = 0
        self._rollout: Rollout | None = None
        self._next_look = float("-inf")
        self._records: deque[dict[str, Any]] = deque()

    def step(self) -> bool:
        """One step of the running evaluation, or a look for a new policy; False where there is none."""
        if self._rollout is None:
            self._rollout = self._begin()
        if self._rollout is None:
            return False
        going_on = self._rollout.step()
        self._env = self._rollout.env
        if not going_on:
            self._records.append(_record(self._rollout, self._version))
            self._rollout = None
        return True

    def _begin(self) -> Rollout | None:
        if self._clock() < self._next_look:
            return None
        self._next_look = self._clock() + POLL_SECONDS
        newest = self._bus.latest_version(evaluate=True)
        weights = self._bus.weights(evaluate=True) if newest is not None and newest > self._version else None
        if weights is None:
            return None
        self._version, blob = weights
        if not self._load(blob):
            return None
        episodes, seconds = self._config.episodes, self._config.evaluation_seconds
        return Rollout(self._runner, self._env, self._make_env, episodes, self._seed, seconds, self._clock)

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
                self._bus.emit(self.name, self._records[0])
                self._records.popleft()
        self._env.close()


def evaluation_record(rollout: Rollout) -> dict[str, Any]:
    """What an evaluation is told by, in records and results."""
    return {
        "eval_return_mean": float(np.mean(rollout.returns)),
        "eval_return_std": float(np.std(rollout.returns)),
        "eval_episodes": len(rollout.returns),
        "eval_cut": int(rollout.cut),
        "eval_broken_episodes": rollout.broken,
    }


def _record(rollout: Rollout, version: Version) -> dict[str, Any]:
    if not rollout.returns:
        return {"eval_broken_episodes": rollout.broken, "eval_update": version.update}
    return evaluation_record(rollout) | {"eval_steps": rollout.steps, "eval_update": version.update}
