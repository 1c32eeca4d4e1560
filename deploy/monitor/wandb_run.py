"""A run in Weights & Biases."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import wandb

from rmc.common.errors import first_line
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.tracking import Tracking

INIT_SECONDS = 15.0  # for the service to answer
STEPS = "env_steps"  # what everything is drawn over
KILLED = 1


class WandbRun:
    """Where the service cannot be reached it is recorded in the run's folder, as by ``WANDB_MODE=offline``."""

    def __init__(self, folder: RunFolder, tracking: Tracking, notify: Callable[[str], None]) -> None:
        try:
            self._run = _begin(folder, tracking, None)
        except wandb.Error as error:
            reason = first_line(error).rstrip(".")
            notify(f"{reason}; recorded offline, and wandb sync {folder.path}/wandb/offline-run-* sends it")
            wandb.teardown()  # of the service that still holds the id
            self._run = _begin(folder, tracking, "offline")
        self._run.define_metric(STEPS)
        self._run.define_metric("*", step_metric=STEPS)

    def log(self, values: dict[str, Any], env_steps: int) -> None:
        self._run.log({STEPS: env_steps, **values})

    def log_video(self, video: Path, env_steps: int) -> None:
        self._run.log({STEPS: env_steps, "video": wandb.Video(str(video), format="mp4")})

    def finish(self, summary: dict[str, Any]) -> None:
        self._run.summary.update(summary)
        self._run.finish(exit_code=0 if summary["state"] in ("finished", "stopped") else KILLED)


def _begin(folder: RunFolder, tracking: Tracking, mode: Any) -> wandb.Run:
    return wandb.init(
        project=tracking.project,
        id=tracking.id,
        name=folder.path.name,
        tags=tracking.tags,
        config=folder.settings(),
        dir=folder.path,
        resume="allow",
        mode=mode,
        settings=wandb.Settings(console="off", silent=True, init_timeout=INIT_SECONDS),
    )
