"""All commands but training, sweeps and the roles, as dataclasses."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, Suppress, arg

from rmc.analysis import baseline_settings
from rmc.analysis.baseline_settings import Algorithm, BaselineConfig
from rmc.analysis.curves import Axis
from rmc.cli.train_options import EnvOptions, KnownEnvOptions, KnownRunDir, field_values, known_run
from rmc.deploy.run.folder import RunFolder

Run = Annotated[Positional[Path], arg(metavar="RUN")]
Runs = Annotated[Positional[tuple[Path, ...]], arg(metavar="RUNS")]
Checkpoint = Annotated[
    str, arg(help="latest, best of those evaluated while it trained, or the number of a checkpoint.")
]


@dataclass(frozen=True)
class Evaluate:
    """Play deterministic episodes with a run's checkpoint, or with a policy file."""

    run: Run
    """The run's folder, a policy file, or hf://owner/name."""
    episodes: int = 10
    """Episodes to play."""
    seconds: float = 0.0
    """Time limit, in seconds; 0 is none. Finished episodes count; if none finished, the first one's return so far."""
    flicker: tuple[float, ...] = ()
    """Probabilities of a missing observation, each of which is played; by default the run's own."""
    checkpoint: Checkpoint = "latest"
    video: Path | None = None
    """Also write an episode to this file, like episode.mp4, with the first of the flicker probabilities."""
    env_timeout: float | None = None
    """Timeout of a call into the environment, in seconds; by default the run's own."""
    json: bool = False
    """Print a line of JSON for each probability."""


@dataclass(frozen=True)
class Export:
    """Write a policy as one file: policy.safetensors for load_policy, or ONNX for programs without torch."""

    run: Run
    """The run's folder, a policy file, or hf://owner/name."""
    out: Path = Path("policy.onnx")
    """The file to write, which ends in .safetensors or .onnx."""
    checkpoint: Checkpoint = "latest"


@dataclass(frozen=True)
class Inspect:
    """Show what a run's world model knows and what its memory holds, as a picture and in numbers."""

    run: Run
    """The run's folder."""
    out: Path = Path("inspect.png")
    """The picture to write."""
    checkpoint: Checkpoint = "latest"


@dataclass(frozen=True)
class CheckEnv:
    """Play an environment at random, and say whether it can be trained on and what to fix."""

    env: EnvOptions
    steps: int = 2_000
    """Random steps to play."""


@dataclass(frozen=True)
class Baseline(BaselineConfig):
    """Train an agent of stable-baselines3 in the same environment, to compare with."""

    algorithm: Positional[Algorithm]
    """Which one."""
    env: EnvOptions
    run_dir: Path | None = None
    """The run's folder; by default runs/<env>__<algorithm>-<settings>__<seed>__<time>. rmc resume continues it."""

    def config(self) -> BaselineConfig:
        """The run's config."""
        return BaselineConfig(**field_values(BaselineConfig, self) | {"env": self.env.config()})


@dataclass(frozen=True)
class ResumeBaseline(Baseline):
    """Continue a baseline's run; options that are not given keep their values."""

    algorithm: Suppress[Algorithm]
    env: KnownEnvOptions
    run_dir: KnownRunDir = None


def known_baseline(folder: RunFolder) -> Baseline:
    """The command that would say all of such a run. Raises ConfigError."""
    config = baseline_settings.read_config(folder)
    return Baseline(**vars(config) | {"env": EnvOptions(**asdict(config.env))})


def resuming_baseline(folder: RunFolder) -> ResumeBaseline:
    """The command that continues such a run, and changes nothing. Raises ConfigError."""
    config = baseline_settings.read_config(folder)
    return ResumeBaseline(**vars(config) | known_run(config.env))


@dataclass(frozen=True)
class Plot:
    """Draw the returns of runs as curves, and print them as a table, by environment and agent."""

    runs: Runs
    """Runs, folders with runs at any depth, quoted patterns like 'runs/*', or a study's files of JSON lines."""
    out: Path = Path("curves.png")
    """The picture to write; or, of a name like x.jsonl, every run's evaluations as a line of JSON."""
    by: Axis = "env_steps"
    """What returns are drawn over."""
    reference: str | None = None
    """The agent, by its name in the table, that the others are scaled by and compared with."""


@dataclass(frozen=True)
class Stats:
    """Show how far a run is, how good, and its newest metrics."""

    run: Run
    """The run's folder."""
    json: bool = False
    """Print one line of JSON, with every metric of every role."""


@dataclass(frozen=True)
class List:
    """List the runs in a folder and below: state, steps, return. Or those that are trained on a Ray cluster."""

    folder: Annotated[Positional[Path], arg(metavar="[FOLDER]")] = Path("runs")
    """Where to look."""
    ray_address: str | None = None
    """Instead, the runs of a Ray cluster, asked from any of its nodes: auto finds the one that this machine is in."""
    json: bool = False
    """Print one line of JSON."""


@dataclass(frozen=True)
class Doctor:
    """Say which stage holds a run back, by how much, and the option that changes it."""

    run: Run
    """The run's folder."""


@dataclass(frozen=True)
class Report:
    """Write one file about runs, for a browser without a network: curves, tables, videos, waits, differences."""

    runs: Runs
    """Runs, also of baselines, folders that hold some at any depth, or quoted patterns."""
    out: Path = Path("report.html")
    """The file to write."""
    video: bool = True
    """Film an episode of each agent's newest policy."""


@dataclass(frozen=True)
class Watch:
    """Show runs on a page in a browser, live; it can only be read."""

    runs: Runs
    """Runs, folders that hold some at any depth, or quoted patterns like 'runs/*'."""
    host: str = "127.0.0.1"
    """The address to serve at. Any but loopback requires the token that the printed URL has."""
    port: int = 8000
    """The port to serve at; 0 takes a free one."""


@dataclass(frozen=True)
class Attach:
    """Watch a run that is being trained; Ctrl-C only stops watching."""

    run: Run
    """The run's folder."""


@dataclass(frozen=True)
class Stop:
    """End a run cleanly; rmc resume continues it."""

    run: Run
    """The run's folder; with --ray-address its name, as rmc list shows it."""
    ray_address: str | None = None
    """End a run of a Ray cluster, from any of its nodes: auto finds the one that this machine is in."""


@dataclass(frozen=True)
class Cluster:
    """Start or stop the machines of a Ray cluster, and check that all of them did."""

    action: Positional[Literal["up", "down"]]
    """What to do."""
    config: Annotated[Positional[Path], arg(metavar="CONFIG")]
    """The cluster's file; deploy/cluster/ has some to start from."""


@dataclass(frozen=True)
class Completion:
    """Print a shell's completion script: commands, options, folders."""

    shell: Positional[Literal["bash", "zsh", "fish"]]
    """Which shell."""
