"""``rmc train`` as a dataclass; tyro makes ``--help`` of it. Options of the roles' configs are flat."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from rmc.common.env.config import EnvConfig, read_kwargs, write_kwargs
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.launch_options import IfExists, InitParts, Launcher, LaunchOptions, Tracker

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
class Train(RunConfig):
    """Train an agent, or continue a run. --help shows the basic options, --help-all all of them."""

    env: EnvOptions
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """A TOML file of options, like env = "HalfCheetah-v5" and learning_rate = 3e-4; those given beside it win."""
    run_dir: Path | None = None
    """The run's folder; by default runs/<env>__<preset>__<seed>__<time>."""
    if_exists: IfExists = "resume"
    """If the run's folder is there. resume: continue it. fail: refuse. new: take a new folder beside it."""
    init_from: str | None = None
    """RUN or RUN:CHECKPOINT whose networks and normaliser it begins with."""
    init_parts: InitParts = "all"
    """Networks to copy: all; memory, world model and imputer; or memory, policy and imputer."""
    launcher: Launcher = "local"
    """local: processes here. ray: a Ray cluster. lockstep: one thread, the same bits again. manual: by hand."""
    device: str = "cpu"
    """The learner's device: cpu, cuda or cuda:N."""
    redis_url: str | None = None
    """A Redis of your own: unix:///path, redis://host:port, rediss://… or file:PATH, a file with the URL; by
    default an embedded one."""
    ray_address: str = "auto"
    """With --launcher ray: auto finds the cluster that this machine is in, local starts one for this run alone."""
    all_cpus: bool = False
    """With --launcher ray: an actor for every CPU left, also of nodes that join later, in place of --actors."""
    tls: bool = False
    """With --launcher ray: encrypt what the roles say across machines; needs a Redis server built with TLS on the
    head."""
    track: Tracker | Literal["off"] | None = None
    """Log to a tracker. The default is the run's last choice, and none for a new run."""
    track_project: str | None = None
    """The tracker's project, by default rmc."""
    track_tags: tuple[str, ...] = ()
    """The run's tags in the tracker."""
    video_every: int | None = None
    """Film every Nth evaluated checkpoint, and the final policy. With a tracker the default is the final one alone."""
    metrics_port: int | None = None
    """Serve the run's metrics to Prometheus on this port, at /metrics; by default on none."""
    metrics_host: str = "127.0.0.1"
    """Where that port listens; 0.0.0.0 is everywhere, and shows the metrics to whoever reaches this machine."""
    dry_run: bool = False
    """Train for some seconds in a temporary folder, and tell what the run needs beside what this machine has: memory,
    disk, bandwidth, handles, threads, time. Exit status 1 where it does not fit."""

    def config(self) -> RunConfig:
        """The run's config."""
        return RunConfig(**values_of(RunConfig, self) | {"env": self.env.config()})

    def launch_options(self) -> LaunchOptions:
        """Where and on what it runs."""
        return LaunchOptions(**values_of(LaunchOptions, self))


def values_of(kind: type[Any], source: Any) -> dict[str, Any]:
    """What ``source`` has for each field of a dataclass."""
    return {item.name: getattr(source, item.name) for item in dataclasses.fields(kind)}


def from_config(config: RunConfig, launch: LaunchOptions) -> Train:
    """The command that would say all of this."""
    options = values_of(RunConfig, config) | values_of(LaunchOptions, launch)
    return Train(**options | {"env": EnvOptions(**dataclasses.asdict(config.env))})


@dataclass(frozen=True)
class Resume(Train):
    """Continue a run. Options that are not given keep their values. --help shows the basic options, --help-all all of
    them; behind RUN they show the run's own values as defaults."""

    env: KnownEnvOptions
    run_dir: KnownRunDir = None
    config_file: tyro.conf.Suppress[Path | None] = None
    if_exists: tyro.conf.Suppress[IfExists] = "resume"
    init_from: tyro.conf.Suppress[str | None] = None
    init_parts: tyro.conf.Suppress[InitParts] = "all"


def resuming(config: RunConfig, launch: LaunchOptions) -> Resume:
    """The command that continues such a run, and changes nothing."""
    return Resume(**vars(from_config(config, launch)) | known_run(config.env))
