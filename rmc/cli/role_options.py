"""The commands that are one role of a run, as dataclasses; launchers start them, or a user by hand."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional


@dataclass(frozen=True)
class LauncherRole:
    """Run the launcher of a run on Ray; rmc train starts it on the head."""

    run: Positional[Path]
    """The run's folder."""
    ray_address: str = "auto"
    """The cluster."""


@dataclass(frozen=True)
class _Role:
    run: str
    """The run's name, as its launcher prints it."""
    redis_url: str = ""
    """The run's Redis; by default what RMC_REDIS_URL says."""


@dataclass(frozen=True)
class _SecretRole(_Role):
    secret_file: Path | None = None
    """File with the run's secret; by default RMC_SECRET holds it."""
    tls_folder: Path | None = None
    """Folder with the run's certificate, if replay servers and learner are to encrypt what they say."""


@dataclass(frozen=True)
class ActorRole(_Role):
    """Run one actor of a registered run in this process."""

    index: int = 0
    """Which actor, from 0 on."""


@dataclass(frozen=True)
class ReplayRole(_SecretRole):
    """Run the replay server of a registered run in this process."""

    folder: Path = Path("replay")
    """Where the ring lies."""
    shard: int = 0
    """Which of the run's replay servers, from 0 on."""
    listen: str = "tcp:127.0.0.1:0"
    """Where the learner connects to: unix:PATH or tcp:HOST:PORT, port 0 for a free one."""


@dataclass(frozen=True)
class LearnerRole(_SecretRole):
    """Run the learner of a registered run in this process."""

    folder: Path = Path("checkpoints")
    """Where checkpoints go, and where it resumes from."""
    device: str = "cpu"
    """cpu, cuda or cuda:N."""


@dataclass(frozen=True)
class EvaluatorRole(_Role):
    """Run the evaluator of a registered run in this process."""


@dataclass(frozen=True)
class Role:
    """Run one role of a run in this process: rmc train starts them, or you do, with --launcher manual."""

    role: (
        Annotated[ActorRole, tyro.conf.subcommand("actor")]
        | Annotated[ReplayRole, tyro.conf.subcommand("replay")]
        | Annotated[LearnerRole, tyro.conf.subcommand("learner")]
        | Annotated[EvaluatorRole, tyro.conf.subcommand("evaluator")]
        | Annotated[LauncherRole, tyro.conf.subcommand("launcher")]
    )
