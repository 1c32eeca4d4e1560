"""Playing a checkpoint: the one way in which ``rmc evaluate`` and the end of a run judge a policy."""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import safetensors.torch
import torch
from rich.console import Console

from rmc.actors.evaluator import Rollout, first_start, play_episodes, told
from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent import Agent
from rmc.common.checkpoint import POLICY, PROGRESS, STATE
from rmc.common.env.make import make_env
from rmc.common.errors import ConfigError, MessageError
from rmc.deploy.run.checkpoint_choice import choose_checkpoint
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder

FINAL_EPISODES = 10  # of a run's first and last evaluation
SAY_SECONDS = 10.0  # between lines that an evaluation goes on
Watch = Callable[[Rollout], None]


class Progress:
    """Prints now and then how far an evaluation is."""

    def __init__(self, console: Console, what: str) -> None:
        self._console, self._what, self._due = console, what, time.monotonic() + SAY_SECONDS

    def __call__(self, match: Rollout) -> None:
        """After each step."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + SAY_SECONDS
            at = f"episode {match.episode + 1} of {match.episodes}, {match.steps:,} steps"
            self._console.print(f"{self._what}: {at}", soft_wrap=True)


def evaluate_blob(
    config: RunConfig,
    blob: bytes,
    episodes: int,
    flicker: float | None = None,
    seconds: float = 0.0,
    watch: Watch = lambda _: None,
) -> dict[str, Any]:
    """Deterministic episodes of a policy, cut after ``seconds`` (0: never): mean, deviation and number of returns."""
    env = config.env if flicker is None else dataclasses.replace(config.env, flicker=flicker)
    spec = config.window_spec()
    runner = PolicyRunner(spec.obs_dim, spec.action_dim, config.agent, envs=1)
    runner.load(blob)
    with _one_thread():
        seed = first_start(config.seed, final=True)
        match = play_episodes(runner, lambda: make_env(env), episodes, seed, seconds, watch)
    return told(match) | {"eval_flicker": env.flicker}


@contextmanager
def _one_thread() -> Iterator[None]:
    """A product's last bits depend on its threads, and an episode on them: so they must not on the machine's cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def evaluate_checkpoint(
    folder: RunFolder,
    config: RunConfig,
    checkpoint: str,
    episodes: int,
    flicker: float | None = None,
    seconds: float = 0.0,
    watch: Watch = lambda _: None,
) -> dict[str, Any]:
    """Deterministic episodes of a run's ``latest``, ``best`` or numbered checkpoint. Raises ConfigError."""
    progress, blob = load_checkpoint(folder, config, checkpoint)
    return {
        "env": config.env.id,
        "preset": config.preset,
        "seed": config.seed,
        "env_steps": progress["env_steps"],
        "updates": progress["updates"],
        **evaluate_blob(config, blob, episodes, flicker, seconds, watch),
    }


def load_checkpoint(folder: RunFolder, config: RunConfig, checkpoint: str) -> tuple[dict[str, Any], bytes]:
    """Progress and policy of a run's ``latest``, ``best`` or numbered checkpoint. Raises ConfigError, also where the
    policy is not this config's.

    The best is of those that were evaluated while it trained, which the last one need not be.
    """
    (_, files), spec = choose_checkpoint(folder, checkpoint), config.window_spec()
    folder.check_sizes(config.env.id, config.sizes())
    try:
        PolicyRunner(spec.obs_dim, spec.action_dim, config.agent, envs=1).load(files[POLICY])
    except MessageError as error:
        raise ConfigError("--checkpoint", checkpoint, f"{error}; use another") from None
    return json.loads(files[PROGRESS]), files[POLICY]


def load_state(folder: RunFolder, checkpoint: str) -> bytes:
    """The learner's whole state of a checkpoint, for ``torch.load``. Raises ConfigError."""
    return choose_checkpoint(folder, checkpoint)[1][STATE]


def initial_policy(config: RunConfig) -> bytes:
    """The policy that the run's learner starts from, before it has learnt anything."""
    spec = config.window_spec()
    torch.manual_seed(config.seed)
    return safetensors.torch.save(Agent(spec.obs_dim, spec.action_dim, config.agent).policy_weights())
