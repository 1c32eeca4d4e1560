"""Where and on what a run runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

IfExists = Literal["resume", "fail", "new"]
Launcher = Literal["local", "ray", "lockstep", "manual"]
Tracker = Literal["wandb", "trackio"]


@dataclass(frozen=True)
class LaunchOptions:
    """Where and on what a run runs; nothing here changes what it learns."""

    run_dir: Path | None
    if_exists: IfExists
    launcher: Launcher
    device: str
    redis_url: str | None
    ray_address: str = "auto"
    all_cpus: bool = False
    tls: bool = False
    track: Tracker | Literal["off"] | None = None
    track_project: str | None = None
    track_tags: tuple[str, ...] = ()
