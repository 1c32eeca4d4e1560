"""The command line from words to a command's dataclass, and the table of all commands."""

import dataclasses
import functools
import logging
import operator
from contextlib import suppress
from typing import Annotated, Any, get_args, get_type_hints

import tyro

from rmc.cli import hub_options, role_options, run_options, sweep_options, train_options
from rmc.cli.config_file import KWARGS, RENAMED, option_values, with_file
from rmc.cli.help_text import ALL_OPTIONS, BASIC, only_basic
from rmc.cli.primitives import PRIMITIVES
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import Preset, RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import MAY_CHANGE
from rmc.deploy.run.option_names import flag, flat
from rmc.deploy.run.presets import preset_config
from rmc.deploy.run.starts import last_launch

log = logging.getLogger(__name__)
HELP = {"-h", "--help", ALL_OPTIONS}
DESCRIPTION = (
    "RMC trains recurrent agents with a world model for partially observed continuous control. "
    "Begin with: rmc train InvertedPendulum-v5 --preset debug. rmc --version says which version this is."
)
FLAT = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
COMMANDS: dict[str, tuple[type, str]] = {  # and what runs each, of rmc.cli: imported then, as many are slow to import
    "train": (train_options.Train, "commands:train"),
    "sweep": (sweep_options.Sweep, "sweep_command:sweep"),
    "resume": (train_options.Resume, "commands:train"),
    "evaluate": (run_options.Evaluate, "policy_commands:evaluate"),
    "export": (run_options.Export, "policy_commands:export_policy"),
    "inspect": (run_options.Inspect, "policy_commands:inspect"),
    "check-env": (run_options.CheckEnv, "analysis_commands:check_env"),
    "baseline": (run_options.Baseline, "policy_commands:baseline"),
    "plot": (run_options.Plot, "analysis_commands:plot"),
    "hub": (hub_options.Hub, "hub_commands:run_hub"),
    "report": (run_options.Report, "analysis_commands:report"),
    "doctor": (run_options.Doctor, "commands:doctor"),
    "stats": (run_options.Stats, "commands:stats"),
    "list": (run_options.List, "commands:list_runs"),
    "watch": (run_options.Watch, "watch_command:watch"),
    "attach": (run_options.Attach, "commands:attach"),
    "stop": (run_options.Stop, "commands:stop"),
    "cluster": (run_options.Cluster, "commands:cluster"),
    "completion": (run_options.Completion, "completion:print_script"),
    "role": (role_options.Role, "role_commands:run_role"),
}
ACTIONS = dict(COMMANDS.values()) | {run_options.ResumeBaseline: COMMANDS["baseline"][1]}


def parse(words: list[str]) -> Any:
    """The command line as a command's class. Raises ConfigError; SystemExit, its message on standard error.

    A run that is there gives the defaults: it is known once the words are parsed with those of the preset.
    """
    words, env = with_file(words, option_names(train_options.Train)) if words[:1] == ["train"] else (words, "")
    for option in (KWARGS, *(("--grid", "--search") if words[:1] == ["sweep"] else ())):
        _check_once(option, words)
    defaults = _defaults(preset_config(_named_preset(words), EnvConfig(env)), LaunchOptions())
    without_help = [word for word in words if word not in HELP]
    if without_help != words and words[0] in defaults:
        with suppress(ConfigError, SystemExit):  # with the preset's, where nothing else can be found out
            defaults = _defaults_of_run(without_help, env, _parsed(without_help, defaults)) or defaults
        return _parsed(words, defaults)
    command = _parsed(words, defaults)
    of_run = _defaults_of_run(words, env, command)
    if of_run is not None:
        return _parsed(words, of_run)
    if isinstance(command, train_options.Train) and not command.env.id:
        fix = "rmc train takes an environment, like HalfCheetah-v5, or --run-dir with a run"
        none = command.run_dir is not None and not (command.run_dir / "config.json").exists()
        raise ConfigError("ENV", "", f"{fix}; {command.run_dir} holds none" if none else fix)
    return command


def _defaults_of_run(words: list[str], env: str, command: Any) -> dict[str, Any] | None:
    """Those of the run that the command continues, None where it begins one. Raises ConfigError, SystemExit."""
    folder = _known_run(command)
    if folder is None:
        return None
    if isinstance(command, train_options.Resume) and folder.is_baseline():
        return {"resume": run_options.resuming_baseline(folder)}
    if isinstance(command, run_options.Baseline):
        return {"baseline": run_options.known_baseline(folder)} if folder.is_baseline() else None
    config = folder.config()
    named = dataclasses.replace(config.env, id=env or config.env.id)
    config = dataclasses.replace(config, env=named)
    as_before = _parsed(words, _defaults(config, last_launch(folder)))
    return _defaults(config, last_launch(folder, as_before.launcher))


def _defaults(config: RunConfig, launch: LaunchOptions) -> dict[str, Any]:
    return {"train": train_options.from_config(config, launch), "resume": train_options.resuming(config, launch)}


def _known_run(command: Any) -> RunFolder | None:
    """The run that the command continues. Raises ConfigError where it must, and there is none."""
    if not isinstance(command, train_options.Train | run_options.Baseline) or command.run_dir is None:
        return None
    if isinstance(command, train_options.Train) and command.if_exists != "resume":
        return None
    folder = RunFolder(command.run_dir)
    if isinstance(command, train_options.Resume):
        folder.settings()
        return folder
    return folder if (folder.path / "config.json").exists() else None


def _parsed(words: list[str], defaults: dict[str, Any]) -> Any:
    """The command, which is as by default where nothing is said."""
    if HELP.difference({ALL_OPTIONS}).intersection(words):
        fixed = {
            path.rpartition(".")[2] for path in flat(preset_config("robust", EnvConfig(""))) if path not in MAY_CHANGE
        }
        shown = {"resume": BASIC - fixed}
        defaults = {name: only_basic(command, shown.get(name, BASIC)) for name, command in defaults.items()}
    words = ["--help" if word == ALL_OPTIONS else word for word in words]
    subcommands = [
        Annotated[type(defaults[name]), tyro.conf.subcommand(name, default=defaults[name])]
        if name in defaults
        else Annotated[kind, tyro.conf.subcommand(name)]
        for name, (kind, _) in COMMANDS.items()
    ]
    kinds: Any = functools.reduce(operator.or_, subcommands)
    read = functools.partial(
        tyro.cli, kinds, prog="rmc", description=DESCRIPTION, args=words, config=FLAT, registry=PRIMITIVES
    )
    if words[:1] == ["sweep"]:  # what it does not know, rmc train may
        _check_sweep_begins(words[1:])
        command, others = read(return_unknown_args=True)
        return dataclasses.replace(command, train_words=tuple(others))
    return read()


def _check_sweep_begins(words: list[str]) -> None:
    """Raises ConfigError where an option of rmc train comes first: whether a value follows it is not known."""
    first = flag(words[0]) if words else ""
    own = {word.replace("_", "-") for word in option_names(COMMANDS["sweep"][0])}
    if first.startswith("--") and first not in HELP and first.removeprefix("--").removeprefix("no-") not in own:
        raise ConfigError("ENV|SPEC.toml", first, "give it first; options of rmc train follow it")


def renamed(words: list[str]) -> list[str]:
    """The words with the new names of options, each of whose old ones is warned of."""
    new_words = []
    for word in words:
        flag, equals, value = word.partition("=")
        no = "no-" if flag.startswith("--no-") else ""
        new = RENAMED.get(flag.replace("_", "-").removeprefix(f"--{no}")) if flag.startswith("--") else None
        if new is not None:
            log.warning("%s is called --%s%s now; the old name goes in the next version", flag, no, new)
        new_words.append(f"--{no}{new}{equals}{value}" if new is not None else word)
    return new_words


def option_names(kind: type) -> list[str]:
    """The names of a command's options, also of those in its parts and subcommands; what has no flag is left out."""
    names: list[str] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if {tyro.conf.Suppress, tyro.conf.Positional}.isdisjoint(getattr(hint, "__metadata__", ())):
            parts = [getattr(part, "__origin__", part) for part in (hint, *get_args(hint))]
            below = [part for part in parts if isinstance(part, type) and dataclasses.is_dataclass(part)]
            names += [own for part in below for own in option_names(part)] or [name]
    return [name for name in names if name not in ("id", "config_file")]


def _check_once(option: str, words: list[str]) -> None:
    """Of two, the parser would drop the first without a word."""
    uses = [word for word in words if flag(word) == option]
    if len(uses) > 1:
        raise ConfigError(option, " ".join(uses), "is there twice; give all of NAME=VALUE after one")


def _named_preset(words: list[str]) -> Preset:
    """The preset must be known before the options, whose defaults it gives; a wrong one is refused later."""
    newest = option_values("--preset", words)[-1:]
    return next((name for name in get_args(Preset) if name in newest), "robust")
