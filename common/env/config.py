"""Which environment, and what is changed about it; readable without gymnasium."""

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np

from rmc.common.errors import ConfigError

RANGES: dict[str, tuple[float, float]] = {  # of EnvConfig's numbers, both ends included
    "flicker": (0, 1),
    "drop_sensors": (0, 1),
    "flicker_burst": (1, 1_000_000),
    "delay": (0, 1_000_000),
    "noise": (0, 1e12),
    "frame_stack": (1, 1_000),
    "action_repeat": (1, 10_000),
    "time_limit": (0, 2**31),
    "env_timeout": (0.1, 1e6),
}
PYTHONS = {"True": True, "False": False, "None": None}  # as Python writes what JSON writes otherwise
NUMBER = re.compile(r"[+-]?((0|[1-9][0-9]*)\.?|(0|[1-9][0-9]*)?\.[0-9]+)([eE][+-]?[0-9]+)?")  # no 007, 1_000 or inf


@dataclass(frozen=True)
class EnvConfig:
    """Which environment, and how much of it is seen."""

    id: str
    """Gymnasium id, like HalfCheetah-v5 or dm_control/walker-walk-v0, or module:EnvId-v0 for your own."""
    flicker: float = 0.0
    """Probability that an observation is replaced by zeros, at every step, the reset included."""
    drop_sensors: float = 0.0
    """Probability that a dimension of the observation is zero, each on its own, at every step, the reset included."""
    flicker_burst: float = 1.0
    """Mean length of a run of missing steps; the share that is missing stays. No effect below 1 / (1 - probability)."""
    delay: int = 0
    """Steps after which an observation reaches the agent; until then it sees the episode's first one."""
    hide: Literal["nothing", "velocities", "positions"] = "nothing"
    """Part of a MuJoCo observation that is left out."""
    noise: float = 0.0
    """Standard deviation of Gaussian noise on every observation, in the observation's own units."""
    frame_stack: int = 1
    """Newest observations that make one, oldest first; a missing frame among them is an ordinary one."""
    action_repeat: int = 1
    """Environment steps per agent step; rewards are added up. All other options but --time-limit count agent steps."""
    time_limit: int = 0
    """Steps of the environment after which an episode is cut off; 0 keeps the environment's own limit."""
    env_timeout: float = 60.0
    """Timeout of a call into an environment, in seconds. Its process then ends; a role is started again."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keywords that the environment is made with, like goal=1.5 map=maze pose=[0,1]: numbers, words, JSON."""

    def __post_init__(self) -> None:
        """Raises ConfigError for an id that a terminal would obey: strangers' files have one."""
        if not str(self.id).isprintable():
            raise ConfigError("ENV", self.id, "give an id of characters that can be seen")

    def takes_away(self) -> bool:
        """Whether any option takes something from the observation."""
        missing = self.flicker or self.drop_sensors
        return bool(missing or self.delay or self.noise) or self.hide != "nothing"

    def label(self) -> str:
        """Its id and what is changed about it: returns of equal labels can be compared. A stack is the agent's own."""
        plain, separate = EnvConfig(self.id), ("frame_stack", "env_timeout", "env_kwargs")
        names = [item.name for item in fields(self) if item.name not in separate]
        odd = [name for name in names if getattr(self, name) != getattr(plain, name)]
        options = (f"{name.replace('_', ' ')} {getattr(self, name)}" for name in odd)
        return ", ".join([self.id, *write_kwargs(dict(sorted(self.env_kwargs.items()))), *options])


def read_kwargs(words: Sequence[str]) -> dict[str, Any]:
    """NAME=VALUE words as keywords, their values typed. Raises ConfigError."""
    kwargs: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (equals and name.isidentifier()):
            raise ConfigError("--env-kwargs", word, "write NAME=VALUE, like goal=1.5, and ENV before them")
        if name in kwargs:
            raise ConfigError("--env-kwargs", word, f"{name} is there twice; give it once")
        kwargs[name] = typed(value)
        if kwargs[name] == value and value.startswith(("[", "{")):
            raise ConfigError("--env-kwargs", word, 'no JSON; keep its quotes from the shell: \'names=["a", "b"]\'')
    check_kwargs(kwargs)
    return kwargs


def write_kwargs(kwargs: dict[str, Any]) -> list[str]:
    """Keywords as the words that ``read_kwargs`` reads."""
    return [f"{name}={_word(value)}" for name, value in kwargs.items()]


def check_env_config(config: EnvConfig) -> None:
    """Raises ConfigError for the first number or keyword that makes no sense."""
    for name, limits in RANGES.items():
        check_range(f"--{name.replace('_', '-')}", getattr(config, name), limits)
    check_kwargs(config.env_kwargs)


def check_range(option: str, value: float, limits: tuple[float, float], kind: type = Real) -> None:
    """Raises ConfigError where it is no number of that kind, Real or Integral, within the limits. NaN never is."""
    low, high = limits
    if isinstance(value, bool) or not isinstance(value, kind) or not low <= value <= high:
        number = "whole number" if kind is Integral else "number"
        raise ConfigError(option, value, f"take a {number} from {low:,} to {high:,}".replace(",", "_"))


def check_kwargs(kwargs: dict[str, Any]) -> None:
    """Raises ConfigError where a value is none that config.json can hold and give back."""
    for name, value in kwargs.items():
        try:
            same = json.loads(json.dumps({name: value}, allow_nan=False, default=plain)) == _listed({name: value})
        except (TypeError, ValueError, RecursionError):
            same = False
        if not same:
            fix = "take finite numbers, text, true, false, null, lists, or dicts with text as keys"
            raise ConfigError(f"--env-kwargs {name}", value, fix)


def _listed(value: Any) -> Any:
    """Tuples as lists, which is what the environment gets of them."""
    if isinstance(value, dict):
        return {name: _listed(one) for name, one in value.items()}
    return [*map(_listed, value)] if isinstance(value, list | tuple) else value


def plain(value: Any) -> Any:
    """One of numpy's numbers as Python's own, for json.dumps. Raises TypeError for what JSON has not."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not JSON's")


def typed(value: str) -> Any:
    """A typed word as Python's or JSON's value, else as text."""
    if value in PYTHONS:
        return PYTHONS[value]
    with suppress(ValueError, RecursionError):
        if NUMBER.fullmatch(value):
            return float(value) if set(".eE").intersection(value) else int(value)
        return json.loads(value, parse_constant=_refuse)
    return value


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not JSON's")


def _word(value: Any) -> str:
    """Quoted where it would be read as another value, or refused."""
    bare = isinstance(value, str) and typed(value) == value and not value.startswith(("[", "{"))
    return value if bare else json.dumps(value)
