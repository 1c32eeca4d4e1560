"""The command line from words to a command's dataclass, and the table of all commands."""

import dataclasses
import functools
import importlib
import itertools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, cast, get_type_hints

import tyro

from rmc.cli import role_options, run_options, sweep_options, train_options
from rmc.cli.config_file import KWARGS, with_file
from rmc.cli.help_text import ALL_OPTIONS, only_basic
from rmc.cli.numerals import NUMERALS
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import Preset, RunConfig
from rmc.deploy.run.presets import preset_config

FLAT = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)


@dataclass(frozen=True)
class Action:
    """What runs a command: a function of a module that is imported when it is called, as many are slow to import."""

    module: str
    function: str

    def __call__(self, command: Any) -> int:
        """Run it; its exit status."""
        run: Callable[[Any], int] = getattr(importlib.import_module(f"rmc.cli.{self.module}"), self.function)
        return run(command)


COMMANDS: dict[str, tuple[type, Action]] = {
    "train": (train_options.Train, Action("commands", "train")),
    "sweep": (sweep_options.Sweep, Action("sweep_command", "sweep")),
    "evaluate": (run_options.Evaluate, Action("analysis_commands", "evaluate")),
    "export": (run_options.Export, Action("analysis_commands", "export_policy")),
    "inspect": (run_options.Inspect, Action("analysis_commands", "inspect")),
    "check-env": (run_options.CheckEnv, Action("analysis_commands", "check_env")),
    "baseline": (run_options.Baseline, Action("analysis_commands", "baseline")),
    "plot": (run_options.Plot, Action("analysis_commands", "plot")),
    "stats": (run_options.Stats, Action("commands", "stats")),
    "attach": (run_options.Attach, Action("commands", "attach")),
    "stop": (run_options.Stop, Action("commands", "stop")),
    "cluster": (run_options.Cluster, Action("commands", "cluster")),
    "completion": (run_options.Completion, Action("completion", "print_script")),
    "role": (role_options.Role, Action("role_commands", "run_role")),
}
ACTIONS = dict(COMMANDS.values())


def parse(words: list[str]) -> Any:
    """The command line as a command's class. Raises ConfigError; SystemExit, its message on standard error."""
    words, env = with_file(words, option_names(train_options.Train)) if words[:1] == ["train"] else (words, "")
    _check_once(KWARGS, words)
    defaults: dict[str, Any] = {"train": _train_defaults(_named_preset(words), env)}
    if {"-h", "--help"}.intersection(words):
        defaults["train"] = only_basic(defaults["train"])
    words = ["--help" if word == ALL_OPTIONS else word for word in words]
    subcommands = [
        Annotated[type(defaults[name]), tyro.conf.subcommand(name, default=defaults[name])]
        if name in defaults
        else Annotated[kind, tyro.conf.subcommand(name)]
        for name, (kind, _) in COMMANDS.items()
    ]
    kinds: Any = functools.reduce(operator.or_, subcommands)
    read = functools.partial(tyro.cli, kinds, prog="rmc", args=words, config=FLAT, registry=NUMERALS)
    if words[:1] == ["sweep"]:  # what it does not know, rmc train may
        command, others = read(return_unknown_args=True)
        return dataclasses.replace(command, train_words=tuple(others))
    return read()


def option_names(kind: type) -> list[str]:
    """The names of a command's options, also of those in its parts; what has no flag is left out."""
    names: list[str] = []
    for name, hint in get_type_hints(kind).items():
        names += option_names(cast(type, hint)) if dataclasses.is_dataclass(hint) else [name]
    return [name for name in names if name not in ("id", "config_file")]


def _train_defaults(preset: Preset, env: str) -> train_options.Train:
    start = preset_config(preset, EnvConfig(""))
    shared = {item.name: getattr(start, item.name) for item in dataclasses.fields(RunConfig) if item.name != "env"}
    return train_options.Train(env=train_options.EnvOptions(id=env or tyro.MISSING), **shared)


def _check_once(option: str, words: list[str]) -> None:
    """Of two, the parser would drop the first without a word."""
    given = [word for word in words if word.partition("=")[0].replace("_", "-") == option]
    if len(given) > 1:
        raise ConfigError(option, " ".join(given), "is there twice; give all of NAME=VALUE after one")


def _named_preset(words: list[str]) -> Preset:
    """The preset must be known before the options, whose defaults it gives; a wrong one is refused later."""
    given = [word.partition("=")[2] for word in words if word.startswith("--preset=")]
    given += [after for word, after in itertools.pairwise(words) if word == "--preset"]
    if "paper" in given[-1:]:
        return "paper"
    return "debug" if "debug" in given[-1:] else "robust"
