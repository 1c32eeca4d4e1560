"""A run's whole configuration: composed from the roles' own, as presets, and to JSON and back.

The only place that knows every config at once; each role is given its own part.
"""

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from actors.actor import ActorConfig
from actors.evaluator import EvaluatorConfig
from common.agent import AgentConfig
from common.envs import EnvConfig, env_spaces
from common.errors import ConfigError
from common.replay import Shard
from common.window import WindowSpec
from learner.learner import LearnerConfig
from learner.update import UpdateConfig
from replay_server.server import ReplayConfig

Preset = Literal["robust", "paper", "debug"]
LARGEST_WINDOW = 32 << 20  # bytes, half of what our Redis takes as a value
ConfigT = TypeVar("ConfigT")


@dataclass(frozen=True)
class WindowConfig:
    """How a window is cut."""

    burn_in: int = 10
    """L_b, steps that only warm the memory up."""
    trained_steps: int = 15
    """L_t, steps that are trained on."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides what a run learns; where and on what it runs is not in here."""

    env: EnvConfig
    """The environment."""
    preset: Preset = "robust"
    """The preset that the other values started from."""
    seed: int = 0
    """Seed of networks, environments, noise and sampling."""
    total_steps: int = 1_000_000
    """Environment steps of the run, over all actors."""
    actors: int = 1
    """Actor processes."""
    window: WindowConfig = field(default_factory=WindowConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    actor: ActorConfig = field(default_factory=ActorConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    update: UpdateConfig = field(default_factory=UpdateConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    evaluator: EvaluatorConfig = field(default_factory=EvaluatorConfig)

    @cached_property
    def _spaces(self) -> tuple[int, int, int | None]:
        return env_spaces(self.env)

    def window_spec(self) -> WindowSpec:
        """The window that every role of the run speaks. Makes an environment once; raises ConfigError."""
        obs_dim, action_dim, time_limit = self._spaces
        burn_in, train, strategy = self.window.burn_in, self.window.trained_steps, self.actor.state_strategy
        if strategy == "episode":
            if time_limit is None:
                raise ConfigError(
                    "--state-strategy", strategy, f"{self.env.id} has no time limit; give --time-limit, or use burn-in"
                )
            train = time_limit
        state = self.agent.state_size(obs_dim)
        spec = WindowSpec(obs_dim, action_dim, state, burn_in if strategy == "burn-in" else 0, train)
        if 4 * spec.observations * (obs_dim + action_dim + 1) > LARGEST_WINDOW:
            name = "--time-limit" if strategy == "episode" else "--trained-steps"
            raise ConfigError(
                name, train, f"a window would have more than {LARGEST_WINDOW >> 20} MiB; take fewer steps"
            )
        return spec

    def shards(self) -> list[Shard]:
        """The replay servers."""
        count = self.replay.replay_shards
        return [Shard(index, count) for index in range(count)]

    def roles(self) -> tuple[str, ...]:
        """The names of all roles."""
        actors = [f"actor-{index}" for index in range(self.actors)]
        return ("learner", "evaluator", *(shard.role for shard in self.shards()), *actors)

    def slack_steps(self) -> int:
        """How far actors may run ahead of the replay ratio: two windows of every environment.

        One is what they may hold back unsent, the other keeps them busy while the credit is on its way.
        """
        return 2 * self.window_spec().train * self.actor.envs_per_actor * self.actors


def preset(name: Preset, env: EnvConfig) -> RunConfig:
    """A preset's RunConfig for an environment."""
    return {"robust": robust, "paper": paper, "debug": debug}[name](env)


def robust(env: EnvConfig) -> RunConfig:
    """The default: what has been learnt since the paper."""
    return RunConfig(
        env=env,
        preset="robust",
        agent=AgentConfig(normalize_observations=True, fill_blanks=True),
        actor=ActorConfig(envs_per_actor=8),
        replay=ReplayConfig(replay_ratio=48.0, priority_exponent=0.0),
        update=UpdateConfig(scheme=3, policy_average=2_000),
        learner=LearnerConfig(batch_size=8, importance_exponent=0.0, publish_updates=80),
    )


def paper(env: EnvConfig) -> RunConfig:
    """What the paper and its authors' code say."""
    return RunConfig(
        env=env,
        preset="paper",
        agent=AgentConfig(embedding=0, grounding=False),
        actor=ActorConfig(envs_per_actor=8),
        replay=ReplayConfig(warmup_steps=10_000),
        update=UpdateConfig(learning_rate=1e-4, alpha_learning_rate=1e-5, policy_q="first", curiosity=0.5),
    )


def debug(env: EnvConfig) -> RunConfig:
    """Small and short: every part runs, within a minute on two cores."""
    return RunConfig(
        env=env,
        preset="debug",
        total_steps=4_000,
        agent=AgentConfig(hidden=32, embedding=32, heads=(64, 64)),
        actor=ActorConfig(envs_per_actor=2),
        replay=ReplayConfig(capacity=2_000, replay_ratio=32.0, warmup_steps=500),
        learner=LearnerConfig(batch_size=16, checkpoint_steps=1_000, precision="fp32"),
        evaluator=EvaluatorConfig(episodes=2),
    )


# -- JSON ---------------------------------------------------------------------------------------------


def to_json(config: RunConfig) -> str:
    """The config as JSON, as in ``config.json`` and in Redis."""
    return json.dumps(dataclasses.asdict(config), indent=2)


def from_json(text: str | bytes) -> RunConfig:
    """The config again. Raises ConfigError on anything unknown, missing or of the wrong type."""
    try:
        raw = json.loads(text)
    except ValueError as error:
        raise ConfigError("config.json", str(error), "not JSON; restore the file or start a new run") from None
    return _build(RunConfig, raw, "")


def _build(kind: type[ConfigT], raw: Any, path: str) -> ConfigT:
    if not isinstance(raw, dict):
        raise ConfigError(f"config.json {path or 'as a whole'}", raw, "must be an object")
    hints = get_type_hints(kind)
    known = {item.name for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for name in sorted(set(raw) ^ known):
        fix = "is missing; the run was made by another version" if name in known else "no such option in this version"
        raise ConfigError(f"config.json {path}{name}", raw.get(name), fix)
    return kind(**{name: _value(hints[name], value, f"{path}{name}") for name, value in raw.items()})


def _value(kind: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _build(typing.cast(type[Any], kind), value, f"{path}.")
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if isinstance(value, list) and len(value) == len(parts):
            return tuple(_value(part, item, path) for part, item in zip(parts, value, strict=True))
    elif _matches(kind, value):
        return float(value) if kind is float else value
    raise ConfigError(f"config.json {path}", value, f"must be {_told(kind)}")


def _told(kind: Any) -> str:
    """What is asked for, in words."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(repr, get_args(kind)))}"
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _matches(kind: Any, value: Any) -> bool:
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) in (types.UnionType, typing.Union):
        return any(_matches(part, value) for part in get_args(kind))
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is kind


# -- What may not be ----------------------------------------------------------------------------------

_RANGES: dict[str, tuple[float, float]] = {  # both ends included; NaN is in no range
    "seed": (0, 2**63 - 1),
    "total_steps": (1, 2**53),
    "actors": (1, 4096),
    "env.flicker": (0, 1),
    "env.noise": (0, 1e12),
    "env.frame_stack": (1, 1_000),
    "env.action_repeat": (1, 10_000),
    "env.time_limit": (0, 2**31),
    "env.env_timeout": (0.1, 1e6),
    "window.burn_in": (0, 10_000),
    "window.trained_steps": (1, 10_000),
    "agent.hidden": (1, 65_536),
    "agent.embedding": (0, 65_536),
    "actor.envs_per_actor": (1, 4096),
    "actor.reward_scale": (1e-12, 1e12),
    "actor.refresh_steps": (1, 2**31),
    "actor.chunk_windows": (1, 65_536),
    "actor.chunk_seconds": (1e-3, 3600),
    "actor.unacked_bytes": (1 << 20, 1 << 40),
    "replay.capacity": (1, 2**40),
    "replay.replay_ratio": (1e-6, 1e9),
    "replay.warmup_steps": (0, 2**53),
    "replay.priority_exponent": (0, 4),
    "replay.replay_shards": (1, 1024),
    "update.learning_rate": (1e-12, 1),
    "update.memory_learning_scale": (0, 1_000),
    "update.alpha_learning_rate": (0, 1),
    "update.gamma": (0, 1),
    "update.polyak": (0, 1),
    "update.clip_norm": (0, 1e12),
    "update.curiosity": (0, 1e12),
    "update.curiosity_steps": (1, 2**53),
    "update.scheme": (1, 6),
    "update.n_step": (1, 10_000),
    "update.eta": (0, 1),
    "update.policy_average": (0, 2**31),
    "learner.batch_size": (1, 65_536),
    "learner.importance_exponent": (0, 1),
    "learner.publish_updates": (1, 2**31),
    "learner.checkpoint_steps": (1, 2**53),
    "learner.keep_checkpoints": (1, 1_000_000),
    "learner.threads": (0, 1024),
    "evaluator.episodes": (1, 10_000),
}


def validate(config: RunConfig) -> None:
    """Raises ConfigError for the first value that makes no sense; the one place that judges numbers."""
    for path, (low, high) in _RANGES.items():
        value: Any = config
        for name in path.split("."):
            value = getattr(value, name)
        if not low <= value <= high:
            raise ConfigError(option(path), value, f"take a number from {low:,} to {high:,}".replace(",", "_"))
    if min(config.agent.heads) < 1:
        raise ConfigError("--heads", config.agent.heads, "take at least 1 unit a layer")
    if config.agent.layer_norm and not config.agent.embedding:
        raise ConfigError("--layer-norm", True, "it normalises the embedding, so it needs --embedding above 0")
    if config.agent.head_input == "observation" and config.update.curiosity:
        raise ConfigError("--curiosity", config.update.curiosity, "it is the error in a memory's change; take 0")
    if config.agent.initial_priority == "actor" and config.replay.priority_exponent == 0.0:
        raise ConfigError(
            "--initial-priority", "actor", "uniform replay has no priorities; try --priority-exponent 0.6"
        )
    if config.replay.replay_shards > config.actors:
        fix = f"every shard needs an actor: take at most --actors={config.actors}"
        raise ConfigError("--replay-shards", config.replay.replay_shards, fix)
    if config.actors % config.replay.replay_shards:
        fix = f"every shard has as many actors: take a multiple of --replay-shards={config.replay.replay_shards}"
        raise ConfigError("--actors", config.actors, fix)
    if not 0 <= config.actor.stride <= config.window.trained_steps:
        raise ConfigError("--stride", config.actor.stride, f"take 0 to --trained-steps={config.window.trained_steps}")
    if config.actor.stride and config.actor.state_strategy == "episode":
        raise ConfigError("--stride", config.actor.stride, "an episode is one window; leave it, or use burn-in")
    if config.agent.blank_flag and config.env.frame_stack > 1:
        raise ConfigError("--blank-flag", True, "a stack of frames has no flag; leave it, or use --frame-stack 1")
    if config.agent.fill_blanks and not config.agent.normalize_observations:
        fix = "it takes --normalize-observations; or leave blanks as they are: --no-fill-blanks"
        raise ConfigError("--fill-blanks", True, fix)
    if not config.update.policy_through_q and config.update.scheme < 4:
        raise ConfigError("--policy-through-q", False, "schemes 1 to 3 have no such way; take --scheme 4, 5 or 6")
    if config.total_steps <= config.replay.warmup_steps:
        raise ConfigError(
            "--total-steps", config.total_steps, f"take more than --warmup-steps={config.replay.warmup_steps}"
        )


def option(path: str) -> str:
    """The command line's name of a config path: ``replay.replay_ratio`` is ``--replay-ratio``."""
    return "--" + path.rpartition(".")[2].replace("_", "-")
