"""Playing a checkpoint: the one way in which ``rmc evaluate`` and the end of a run judge a policy."""

import dataclasses
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import safetensors.torch
from rich.console import Console

from rmc.actors.evaluator import Rollout, evaluation_record, first_start, play_episodes
from rmc.actors.policy_runner import one_thread
from rmc.analysis.policy_file import PolicyFile, policy_runner
from rmc.common.agent import initial_agent
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import first_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError, EnvFault
from rmc.common.policy_header import PolicyHeader
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.env_sizes import check_sizes, env_sizes, layout_sizes

FINAL_EPISODES = 10  # of a run's first and last evaluation
SAY_SECONDS = 10.0  # between lines that an evaluation goes on
Watch = Callable[[Rollout], None]


class EvaluationProgress:
    """Prints now and then how far an evaluation is; one that ``keeps`` is cut by an interrupt."""

    def __init__(self, console: Console, what: str, keeps: bool = False) -> None:
        self._console, self._what, self._due = console, what, time.monotonic() + SAY_SECONDS
        self._keeps = keeps
        self._rollout: Rollout | None = None

    @property
    def stopped(self) -> bool:
        """Whether the evaluation was interrupted, and its episodes that were over are kept."""
        return self._rollout is not None and self._rollout.stopped

    def __call__(self, rollout: Rollout) -> None:
        """After each step."""
        self._rollout, rollout.keeps = rollout, self._keeps
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + SAY_SECONDS
            at = f"episode {rollout.episode + 1} of {rollout.episodes}, {rollout.steps:,} steps"
            self._console.print(f"{self._what}: {at}", soft_wrap=True)


def missing_shares(env: EnvConfig) -> dict[str, float]:
    """What an evaluation's record says of the observations that were missing."""
    return {"eval_flicker": env.flicker, "eval_drop_sensors": env.drop_sensors}


def policy_env(header: PolicyHeader, config: EnvConfig) -> Env:
    """An environment for a policy to act in. Raises ConfigError, also where its sizes are not the policy's."""
    env = first_env(config)
    try:
        check_sizes(config.id, layout_sizes(header.layout), env_sizes(env, config))
    except ConfigError:
        env.close()
        raise
    return env


def _playable(header: PolicyHeader, config: EnvConfig) -> Env:
    """``policy_env`` that says what is missing as it did in training: by the frame, or by number."""
    env = policy_env(header, config)
    flags = 1
    with suppress(EnvFault):  # which its first episode will judge
        flags = np.size(env.reset(seed=0)[1].get("missing", False))  # an evaluation seeds every episode
    if flags not in (1, header.layout.missing):
        env.close()
        fix = f"the environment now gives {flags}, the policy reads {header.layout.missing}; undo that"
        raise ConfigError('info["missing"]', f"{flags} flags", fix)
    return env


def evaluate_policy(
    policy: PolicyFile, episodes: int, flicker: float | None = None, seconds: float = 0.0, watch: Watch = lambda _: None
) -> dict[str, Any]:
    """Deterministic episodes of a policy, cut after ``seconds`` (0: never): its returns, and where it comes from.

    Raises ConfigError where its environment cannot be made, or has other sizes than the policy; EnvFault where it
    breaks in every episode.
    """
    header = policy.header
    env = header.env if flicker is None else dataclasses.replace(header.env, flicker=flicker)
    runner, seed = policy_runner(header, policy.blob), first_start(header.seed, final=True)
    with one_thread():
        try:
            rollout = play_episodes(runner, lambda: _playable(header, env), episodes, seed, seconds, watch)
        except EnvFault as fault:
            raise EnvFault(f"{fault}; rmc check-env {env.id} says more") from fault
    about = {name: getattr(header, name) for name in ("preset", "seed", "env_steps", "updates")}
    return {"env": env.id, **about, **evaluation_record(rollout), **missing_shares(env)}


def initial_policy(config: RunConfig) -> bytes:
    """The policy that the run's learner starts from, before it has learnt anything."""
    agent = initial_agent(config.window_spec(), config.agent, config.seed)
    return safetensors.torch.save(agent.policy_weights())
