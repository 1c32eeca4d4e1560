"""A run's whole configuration: composed from the roles' own, and to JSON and back.

The only place that knows every config at once; each role is given its own part.
"""

import dataclasses
import json
import secrets
import types
import typing
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from rmc.actors.config import ActorConfig, EvaluatorConfig
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.metrics_record import LARGEST
from rmc.common.bus.protocol import actor_role
from rmc.common.env.config import EnvConfig, check_kwargs, plain
from rmc.common.env.layout import EnvLayout
from rmc.common.env.make import env_layout
from rmc.common.errors import ConfigError
from rmc.common.policy_header import PolicyHeader
from rmc.common.shard import Shard
from rmc.common.window import WindowSpec
from rmc.deploy.run.env_sizes import FLAGS, layout_sizes
from rmc.deploy.run.migrations import FORMAT
from rmc.deploy.run.option_names import flat
from rmc.learner.config import LearnerConfig, UpdateConfig
from rmc.replay_server.config import ReplayConfig

Preset = Literal["robust", "memory", "paper", "debug"]
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
    preset: Preset
    """Where the other options' defaults come from."""
    seed: int = 0
    """Seed of networks, environments, noise and sampling."""
    total_steps: int = 1_000_000
    """Agent steps of all actors, more than --warmup-steps. With action_repeat K each is K environment steps."""
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
    def layout(self) -> EnvLayout:
        """What the agent reads and gives. Makes an environment once; raises ConfigError."""
        return env_layout(self.env, self.agent.privileged_critic)

    def window_spec(self) -> WindowSpec:
        """The window that every role of the run speaks. Makes an environment once; raises ConfigError."""
        layout = self.layout
        obs_dim, action_dim, time_limit = layout.obs_dim, layout.action_dim, layout.time_limit
        burn_in, train, strategy = self.window.burn_in, self.window.trained_steps, self.actor.state_strategy
        if strategy == "episode":
            if time_limit is None:
                raise ConfigError(
                    "--state-strategy", strategy, f"{self.env.id} has no time limit; give --time-limit, or use burn-in"
                )
            train = time_limit
        state = self.agent.state_size(obs_dim)
        burn_in = burn_in if strategy == "burn-in" else 0
        spec = WindowSpec(obs_dim, action_dim, state, burn_in, train, layout.missing, layout.privileged)
        self._check_window(spec)
        return spec

    def _check_window(self, spec: WindowSpec) -> None:
        """Raises ConfigError where a window is larger than a message may be."""
        most = LARGEST_WINDOW // (4 * (spec.statistics + spec.action_dim + 1) + spec.missing) - 1 - spec.burn_in
        if spec.train <= most:
            return
        fault, repeat = f"a window would have more than {LARGEST_WINDOW >> 20} MiB", self.env.action_repeat
        if most < 1:
            raise ConfigError("--burn-in", spec.burn_in, f"{fault}; take fewer steps, or smaller observations")
        if self.actor.state_strategy == "episode":
            raise ConfigError("--time-limit", spec.train * repeat, f"{fault}; take at most {most * repeat}")
        raise ConfigError("--trained-steps", spec.train, f"{fault}; take at most {most}")

    def policy_header(self) -> PolicyHeader:
        """What the files of this run's policies say about themselves, before any step. Raises ConfigError."""
        return PolicyHeader(FORMAT, version("rmc-rl"), self.env, self.layout, self.agent, self.preset, self.seed)

    def sizes(self) -> dict[str, Any]:
        """What a run's networks and windows were made for, in words, bounds as lists. Raises ConfigError."""
        spec = self.window_spec()
        whole = {"steps an episode": spec.train} if self.actor.state_strategy == "episode" else {}
        privileged = {"privileged numbers": spec.privileged} if spec.privileged else {}
        return {**layout_sizes(self.layout), FLAGS: spec.missing, **privileged, **whole}

    def shards(self) -> list[Shard]:
        """The replay servers."""
        count = self.replay.replay_shards
        return [Shard(index, count) for index in range(count)]

    def roles(self) -> tuple[str, ...]:
        """The names of all roles."""
        actors = [actor_role(index) for index in range(self.actors)]
        evaluator = ("evaluator",) if self.evaluator.episodes else ()
        return ("learner", *evaluator, *(shard.role for shard in self.shards()), *actors)

    def slack_steps(self) -> int:
        """How far actors may run ahead of the replay ratio: two windows of every environment.

        One is what they may hold back unsent, the other keeps them busy while the credit is on its way.
        """
        return 2 * self.window_spec().train * self.actor.envs_per_actor * self.actors


# JSON


def to_json(config: Any) -> str:
    """A run's config, or a baseline's, as JSON, as in ``config.json``."""
    return json.dumps({"format": FORMAT} | dataclasses.asdict(config), indent=2)


def checked(config: RunConfig) -> RunConfig:
    """The same, as it would come out of ``config.json``. Raises ConfigError for a value of a wrong type or choice."""
    if not isinstance(config, RunConfig):
        raise ConfigError("config", config, "take a RunConfig, like one of rmc.presets")
    if isinstance(kwargs := getattr(config.env, "env_kwargs", None), dict):
        check_kwargs(kwargs)
    for path, value in flat(config).items():
        try:
            json.dumps(value, default=plain)
        except (TypeError, ValueError) as error:
            raise ConfigError(path, value, f"{error}; take numbers, text, True, False or lists of such") from None
    return from_dict(RunConfig, json.loads(json.dumps(dataclasses.asdict(config), default=plain)), "")


def to_registration(config: RunConfig) -> bytes:
    """The config as JSON for the roles: with it a role knows the environment's sizes without making one.

    No two are alike, so that a start tells its own from that of an earlier one.
    """
    own = {"layout": dataclasses.asdict(config.layout), "start": secrets.token_hex(8)}
    return json.dumps(dataclasses.asdict(config) | own).encode()


def from_registration(text: bytes) -> RunConfig:
    """The config again. Raises ConfigError."""
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError("config.json", str(error), "not JSON; restore the file or start a new run") from None
    if isinstance(raw, dict):
        raw.pop("start", None)
    layout: Any = raw.pop("layout", None) if isinstance(raw, dict) else None
    config = from_dict(RunConfig, raw, "config.json ")
    config.__dict__["layout"] = from_dict(EnvLayout, layout, "layout ")  # where the cached property keeps it
    return config


def from_dict(kind: type[ConfigT], raw: Any, path: str) -> ConfigT:
    """A dataclass from what JSON holds of it; ``path`` is what leads there, in words. Raises ConfigError."""
    if not isinstance(raw, dict):
        raise ConfigError(path.rstrip(". "), raw, f"must be an object, in Python of class {kind.__name__}")
    hints = get_type_hints(kind)
    names = {item.name for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for name in sorted(set(raw) ^ names):
        fix = "is missing; the run was made by another version" if name in names else "no such option in this version"
        raise ConfigError(f"{path}{name}", raw.get(name), fix)
    return kind(**{name: value_of_kind(hints[name], value, f"{path}{name}") for name, value in raw.items()})


def value_of_kind(kind: Any, value: Any, path: str) -> Any:
    """What JSON holds as a value of that type, called ``path``. Raises ConfigError."""
    if dataclasses.is_dataclass(kind):
        return from_dict(typing.cast(type[Any], kind), value, f"{path}.")
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if isinstance(value, list) and parts[-1] is ...:
            return tuple(value_of_kind(parts[0], item, f"{path}[{index}]") for index, item in enumerate(value))
        if isinstance(value, list) and len(value) == len(parts):
            return tuple(value_of_kind(part, item, path) for part, item in zip(parts, value, strict=True))
    elif _matches(kind, value):
        return float(value) if kind is float else value
    raise ConfigError(path, value, f"must be {_expected(kind)}")


def _expected(kind: Any) -> str:
    """What is asked for, in words."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(repr, get_args(kind)))}"
    if get_origin(kind) in (types.UnionType, typing.Union):
        return " or ".join(map(_expected, get_args(kind)))
    if kind is types.NoneType:
        return "None"
    return kind.__name__ if isinstance(kind, type) else str(kind)


def _matches(kind: Any, value: Any) -> bool:
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) in (types.UnionType, typing.Union):
        return any(_matches(part, value) for part in get_args(kind))
    if get_origin(kind) is dict:
        return isinstance(value, dict)
    if kind is float:
        return type(value) is float or (type(value) is int and abs(value) < LARGEST)
    return type(value) is kind
