"""``rmc train --help`` shows the basic options; ``--help-all`` shows all of them."""

import dataclasses
import functools
import typing
from collections.abc import Set
from typing import Annotated, Any

import tyro

BASIC = frozenset(
    {
        "id", "flicker", "env_kwargs", "config_file", "preset", "seed", "total_steps", "actors", "run_dir",
        "init_from", "launcher", "device", "redis_url", "dry_run", "capacity", "replay_ratio",
        "learning_rate", "curiosity", "batch_size", "checkpoint_steps", "episodes", "threads", "track",
    }
)  # fmt: skip
ALL_OPTIONS = "--help-all"


def only_basic(command: Any, names: Set[str]) -> Any:
    """A command's dataclass of whose options the help shows those of these ``names``; it is for showing help alone."""
    kind = type(command)
    hints = typing.get_type_hints(kind, include_extras=True)
    values = {item.name: getattr(command, item.name) for item in dataclasses.fields(command)}
    values |= {name: only_basic(value, names) for name, value in values.items() if dataclasses.is_dataclass(value)}
    changed: list[tuple[str, Any, Any]] = []
    for name, value in values.items():
        if dataclasses.is_dataclass(value):
            changed.append((name, type(value), dataclasses.field(default=value)))
        elif name not in names:
            default = dataclasses.field(default_factory=functools.partial(lambda same: same, value))
            changed.append((name, Annotated[hints[name], tyro.conf.Suppress], default))
    shown = dataclasses.make_dataclass(kind.__name__, changed, bases=(kind,), frozen=True, kw_only=True)
    shown.__doc__ = kind.__doc__
    return shown(**values)
