"""Where and on what a run runs, and what it begins with."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

IfExists = Literal["resume", "fail", "new"]
Launcher = Literal["local", "ray", "lockstep", "manual"]
Tracker = Literal["wandb", "trackio", "mlflow"]
PATH_VARIABLE = "RMC_PATH"  # folder of the script that trains, whose modules the run's processes may import
InitParts = Literal["all", "memory+world-model", "policy"]


def users_path() -> dict[str, str]:
    """The variable, for a process on another machine; empty where no script trains."""
    return {PATH_VARIABLE: os.environ[PATH_VARIABLE]} if PATH_VARIABLE in os.environ else {}


@dataclass(frozen=True)
class LaunchOptions:
    """Where and on what a run runs, which changes nothing of what it learns; and the weights that it begins with."""

    run_dir: Path | None
    if_exists: IfExists = "resume"
    launcher: Launcher = "local"
    device: str = "cpu"
    redis_url: str | None = None
    ray_address: str = "auto"
    all_cpus: bool = False
    tls: bool = False
    init_from: str | None = None
    init_parts: InitParts = "all"
    track: Tracker | Literal["off"] | None = None
    track_project: str | None = None
    track_tags: tuple[str, ...] = ()
    video_every: int | None = None
    metrics_port: int | None = None
    metrics_host: str = "127.0.0.1"

    @property
    def goes_on(self) -> bool:
        """Whether its folder has a run, which goes on."""
        return self.run_dir is not None and self.if_exists != "new" and (self.run_dir / "config.json").exists()
