"""``rmc train`` as a dataclass; tyro makes ``--help`` of it. Options of the roles' configs are flat."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from rmc.common.env.config import EnvConfig, read_kwargs, write_kwargs
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.launch_options import IfExists, InitParts, LaunchOptions

KEYWORDS = PrimitiveConstructorSpec(
    nargs="*",
    metavar="NAME=VALUE",
    instance_from_str=read_kwargs,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=write_kwargs,
)


@dataclass(frozen=True)
class EnvOptions(EnvConfig):
    """The environment, and what the agent sees of it."""

    id: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Gymnasium id, like HalfCheetah-v5 or dm_control/walker-walk-v0, or module:EnvId-v0 for your own."""
    env_kwargs: Annotated[dict[str, Any], KEYWORDS] = field(default_factory=dict)
    """Keywords that the environment is made with, like goal=1.5 map=maze pose=[0,1]: numbers, words, JSON."""

    def config(self) -> EnvConfig:
        """The same, as the roles know it."""
        return EnvConfig(**dataclasses.asdict(self))


@dataclass(frozen=True)
class KnownEnvOptions(EnvOptions):
    """The environment of a run that is there."""

    id: tyro.conf.Suppress[str]


KnownRunDir = Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RUN", help="The run's folder.")]


def known_run(env: EnvConfig) -> dict[str, Any]:
    """The options that say which run goes on; its folder must be given."""
    return {"env": KnownEnvOptions(**dataclasses.asdict(env)), "run_dir": tyro.MISSING}


@dataclass(frozen=True)
class Train(LaunchOptions, RunConfig):
    """Train an agent, or continue a run. --help shows the basic options, --help-all all of them."""

    env: EnvOptions
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """A TOML file of options, like env = "HalfCheetah-v5" and learning_rate = 3e-4; those given beside it win."""
    dry_run: bool = False
    """Train for seconds in a temporary folder, and tell whether the run fits here; the exit status is 1 if not."""

    def config(self) -> RunConfig:
        """The run's config."""
        return RunConfig(**field_values(RunConfig, self) | {"env": self.env.config()})

    def launch_options(self) -> LaunchOptions:
        """Where and on what it runs."""
        return LaunchOptions(**field_values(LaunchOptions, self))


def field_values(kind: type[Any], source: Any) -> dict[str, Any]:
    """What ``source`` has for each field of a dataclass."""
    return {item.name: getattr(source, item.name) for item in dataclasses.fields(kind)}


def from_config(config: RunConfig, launch: LaunchOptions) -> Train:
    """The command that would say all of this."""
    options = field_values(RunConfig, config) | field_values(LaunchOptions, launch)
    return Train(**options | {"env": EnvOptions(**dataclasses.asdict(config.env))})


@dataclass(frozen=True)
class Resume(Train):
    """Continue a run. Options that are not given keep their values. --help shows the basic options, --help-all all of
    them, with the defaults of robust; behind RUN they show the run's own values."""

    env: KnownEnvOptions
    run_dir: KnownRunDir = None
    config_file: tyro.conf.Suppress[Path | None] = None
    if_exists: tyro.conf.Suppress[IfExists] = "resume"
    init_from: tyro.conf.Suppress[str | None] = None
    init_parts: tyro.conf.Suppress[InitParts] = "all"


def resuming(config: RunConfig, launch: LaunchOptions) -> Resume:
    """The command that continues such a run, and changes nothing."""
    return Resume(**vars(from_config(config, launch)) | known_run(config.env))
