"""The command line as dataclasses; tyro makes ``--help`` of them. Options of the roles' configs are flat."""

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional
from tyro.constructors import PrimitiveConstructorSpec

from rmc.actors.config import ActorConfig, EvaluatorConfig
from rmc.analysis.baseline_settings import Algorithm, BaselineConfig
from rmc.analysis.curves import Axis
from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig, read_kwargs, write_kwargs
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import Preset, RunConfig, WindowConfig
from rmc.deploy.run.launch_options import IfExists, Launcher, LaunchOptions
from rmc.deploy.run.presets import preset_config
from rmc.learner.config import LearnerConfig, UpdateConfig
from rmc.replay_server.config import ReplayConfig

KEYWORDS = PrimitiveConstructorSpec(
    nargs="*",
    metavar="NAME=VALUE",
    instance_from_str=read_kwargs,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=write_kwargs,
)


@dataclass(frozen=True)
class EnvOptions(EnvConfig):
    """The environment, its id without a flag."""

    id: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Gymnasium id, like HalfCheetah-v5 or dm_control/walker-walk-v0, or module:EnvId-v0 for your own."""
    env_kwargs: Annotated[dict[str, Any], KEYWORDS] = field(default_factory=dict)
    """Keywords that the environment is made with, like goal=1.5 map=maze pose=[0,1]: numbers, words, JSON."""

    def config(self) -> EnvConfig:
        """The same, as the roles know it."""
        return EnvConfig(**dataclasses.asdict(self))


@dataclass(frozen=True)
class Train:
    """Train an agent, or go on with a run."""

    env: EnvOptions
    window: WindowConfig
    agent: AgentConfig
    actor: ActorConfig
    replay: ReplayConfig
    update: UpdateConfig
    learner: LearnerConfig
    evaluator: EvaluatorConfig
    preset: Preset = "robust"
    """Where the other options' defaults come from."""
    seed: int = 0
    """Seed of networks, environments, noise and sampling."""
    total_steps: int = 1_000_000
    """Environment steps of the run, over all actors."""
    actors: int = 1
    """Actor processes."""
    run_dir: Path | None = None
    """The run's folder; by default runs/<env>__<preset>__<seed>__<time>."""
    if_exists: IfExists = "resume"
    """What to do if the run's folder is there: go on, refuse, or take a new one beside it."""
    launcher: Launcher = "local"
    """Processes on this machine; on a Ray cluster; every role in one thread, the same seed giving the same bits; or
    by hand."""
    device: str = "cpu"
    """The learner's device: cpu or cuda."""
    redis_url: str | None = None
    """A Redis of your own: unix:///path, redis://host:port, rediss://… or file:PATH, which holds such a line; by
    default an embedded one."""
    ray_address: str = "auto"
    """With --launcher ray: auto finds the cluster that this machine is in, local starts one for this run alone."""
    all_cpus: bool = False
    """With --launcher ray: an actor for every CPU left, also of nodes that join later, in place of --actors."""
    tls: bool = False
    """With --launcher ray: encrypt what the roles say across machines; needs a Redis server built with TLS on the
    head."""

    def config(self) -> RunConfig:
        """The run's config."""
        own = {item.name: getattr(self, item.name) for item in dataclasses.fields(RunConfig) if item.name != "env"}
        return RunConfig(env=self.env.config(), **own)

    def launch_options(self) -> LaunchOptions:
        """Where and on what it runs."""
        return LaunchOptions(
            self.run_dir,
            self.if_exists,
            self.launcher,
            self.device,
            self.redis_url,
            self.ray_address,
            self.all_cpus,
            self.tls,
        )


@dataclass(frozen=True)
class Evaluate:
    """Play deterministic episodes with a run's checkpoint."""

    run: Positional[Path]
    """The run's folder."""
    episodes: int = 10
    """Episodes to play."""
    seconds: float = 0.0
    """Seconds after which no more are played: those that are over count, or else the first as far as it came. 0 plays
    all."""
    flicker: tuple[float, ...] = ()
    """Probabilities of a missing observation, each of which is played; by default the run's own."""
    checkpoint: str = "latest"
    """latest, best of those evaluated while it trained, or the number of a checkpoint."""
    video: Path | None = None
    """Also write an episode to this file, like episode.mp4, with the first of the flicker probabilities."""
    json: bool = False
    """Print one line of JSON."""


@dataclass(frozen=True)
class Export:
    """Write a run's policy as an ONNX file, for programs without torch."""

    run: Positional[Path]
    """The run's folder."""
    out: Path = Path("policy.onnx")
    """The file to write."""
    checkpoint: str = "latest"
    """latest, best of those evaluated while it trained, or the number of a checkpoint."""


@dataclass(frozen=True)
class Inspect:
    """Show what a run's world model knows: a picture of one episode, predicted against real."""

    run: Positional[Path]
    """The run's folder."""
    out: Path = Path("inspect.png")
    """The picture to write."""
    checkpoint: str = "latest"
    """latest, best of those evaluated while it trained, or the number of a checkpoint."""


@dataclass(frozen=True)
class CheckEnv:
    """Play an environment at random, and say whether it can be trained on and what to mend."""

    env: EnvOptions
    steps: int = 2_000
    """Random steps to play."""


@dataclass(frozen=True)
class Baseline(BaselineConfig):
    """Train an agent of stable-baselines3 in the same environment, to compare with; or go on with such a run."""

    algorithm: Positional[Algorithm]
    """Which one."""
    env: EnvOptions
    run_dir: Path | None = None
    """The run's folder; by default runs/<env>__<algorithm>-<settings>__<seed>__<time>. The same one goes on."""

    def config(self) -> BaselineConfig:
        """The run's config."""
        own = {item.name: getattr(self, item.name) for item in dataclasses.fields(BaselineConfig)}
        return BaselineConfig(**own | {"env": self.env.config()})


@dataclass(frozen=True)
class Plot:
    """Draw the returns of runs as curves, and print them as a table, by environment and agent."""

    runs: Positional[tuple[Path, ...]]
    """Folders of runs, or files of JSON lines as a study writes them."""
    out: Path = Path("curves.png")
    """The picture to write."""
    by: Axis = "env_steps"
    """What returns are drawn over."""
    reference: str | None = None
    """The agent, by its name in the table, that the others are scaled by and compared with."""


@dataclass(frozen=True)
class Stats:
    """Show the newest metrics of a run."""

    run: Positional[Path]
    """The run's folder."""


@dataclass(frozen=True)
class Attach:
    """Watch a run that is being trained; Ctrl-C only stops watching."""

    run: Positional[Path]
    """The run's folder."""


@dataclass(frozen=True)
class Stop:
    """End a run in order; rmc train with its folder goes on with it."""

    run: Positional[Path]
    """The run's folder."""


@dataclass(frozen=True)
class Cluster:
    """Bring the machines of a Ray cluster up, or take them down, and see that all of them are."""

    action: Positional[Literal["up", "down"]]
    """What to do."""
    config: Positional[Path]
    """The cluster's file; deploy/cluster/ has some to start from."""


@dataclass(frozen=True)
class LauncherRole:
    """Be the launcher of a run on Ray; rmc train starts it on the head."""

    run: Positional[Path]
    """The run's folder."""
    ray_address: str = "auto"
    """The cluster."""
    device: str = "cpu"
    """The learner's device."""
    all_cpus: bool = False
    """An actor for every CPU left."""
    tls: bool = False
    """Encrypt what the roles say across machines."""


@dataclass(frozen=True)
class _Role:
    run: str
    """The run's name, as its launcher prints it."""
    redis_url: str = ""
    """The run's Redis; by default what RMC_REDIS_URL says."""


@dataclass(frozen=True)
class ActorRole(_Role):
    """Run one actor of a registered run in this process."""

    index: int = 0
    """Which actor, from 0 on."""


@dataclass(frozen=True)
class ReplayRole(_Role):
    """Run the replay server of a registered run in this process."""

    folder: Path = Path("replay")
    """Where the ring lies."""
    shard: int = 0
    """Which of the run's replay servers, from 0 on."""
    listen: str = "tcp:127.0.0.1:0"
    """Where the learner connects to: unix:PATH or tcp:HOST:PORT, port 0 for a free one."""
    secret_file: Path | None = None
    """File with the run's secret; by default RMC_SECRET holds it."""
    tls_folder: Path | None = None
    """Folder with the run's certificate, if replay servers and learner are to encrypt what they say."""


@dataclass(frozen=True)
class LearnerRole(_Role):
    """Run the learner of a registered run in this process."""

    folder: Path = Path("checkpoints")
    """Where checkpoints go, and where it resumes from."""
    device: str = "cpu"
    """cpu or cuda."""
    secret_file: Path | None = None
    """File with the run's secret; by default RMC_SECRET holds it."""
    tls_folder: Path | None = None
    """Folder with the run's certificate, if replay servers and learner are to encrypt what they say."""


@dataclass(frozen=True)
class EvaluatorRole(_Role):
    """Run the evaluator of a registered run in this process."""


Command = (
    Train | Evaluate | Export | Inspect | CheckEnv | Baseline | Plot | Stats | Attach | Stop | Cluster
    | LauncherRole | ActorRole | ReplayRole | LearnerRole | EvaluatorRole
)  # fmt: skip


def parse(words: list[str]) -> Command:
    """The command line as one of the classes above. Raises ConfigError; SystemExit, its message on standard error."""
    _check_once("--env-kwargs", words)
    start = preset_config(_named_preset(words), EnvConfig(""))
    shared = {item.name: getattr(start, item.name) for item in dataclasses.fields(RunConfig) if item.name != "env"}
    commands = (
        Annotated[Train, tyro.conf.subcommand("train", default=Train(env=EnvOptions(id=tyro.MISSING), **shared))]
        | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Inspect, tyro.conf.subcommand("inspect")]
        | Annotated[CheckEnv, tyro.conf.subcommand("check-env")]
        | Annotated[Baseline, tyro.conf.subcommand("baseline")]
        | Annotated[Plot, tyro.conf.subcommand("plot")]
        | Annotated[Stats, tyro.conf.subcommand("stats")]
        | Annotated[Attach, tyro.conf.subcommand("attach")]
        | Annotated[Stop, tyro.conf.subcommand("stop")]
        | Annotated[Cluster, tyro.conf.subcommand("cluster")]
        | Annotated[LauncherRole, tyro.conf.subcommand("launcher")]
        | Annotated[ActorRole, tyro.conf.subcommand("actor")]
        | Annotated[ReplayRole, tyro.conf.subcommand("replay")]
        | Annotated[LearnerRole, tyro.conf.subcommand("learner")]
        | Annotated[EvaluatorRole, tyro.conf.subcommand("evaluator")]
    )
    flat = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    command: Command = tyro.cli(commands, prog="rmc", args=words, config=flat)
    return command


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
