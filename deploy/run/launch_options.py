"""Where and on what a run runs, and what it begins with."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

IfExists = Literal["resume", "fail", "new"]
Launcher = Literal["local", "ray", "lockstep", "manual"]
TrackerName = Literal["wandb", "trackio", "mlflow"]
PATH_VARIABLE = "RMC_PATH"  # folder of the script that trains, whose modules the run's processes may import
InitParts = Literal["all", "memory+world-model", "policy"]


def users_path() -> dict[str, str]:
    """The variable, for a process on another machine; empty where no script trains."""
    return {PATH_VARIABLE: os.environ[PATH_VARIABLE]} if PATH_VARIABLE in os.environ else {}


@dataclass(frozen=True)
class LaunchOptions:
    """Where and on what a run runs, which changes nothing of what it learns; and the weights that it begins with."""

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
    """Your own Redis: unix:///path, redis://host:port, rediss://… or file:PATH with the URL. None: an embedded one."""
    ray_address: str = "auto"
    """With --launcher ray: auto finds the cluster that this machine is in, local starts one for this run alone."""
    all_cpus: bool = False
    """With --launcher ray: an actor for every CPU left, also of nodes that join later, in place of --actors."""
    tls: bool = False
    """With --launcher ray: encrypt what crosses machines. The head's Redis server must be built with TLS."""
    track: TrackerName | Literal["off"] | None = None
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

    @property
    def goes_on(self) -> bool:
        """Whether its folder has a run, which goes on."""
        return self.run_dir is not None and self.if_exists != "new" and (self.run_dir / "config.json").exists()
