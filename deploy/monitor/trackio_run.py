"""A run in Trackio, which keeps runs on this machine, or in a Space of Hugging Face where its variables name one."""

from pathlib import Path
from typing import Any

import trackio

from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.tracking import Tracking


class TrackioRun:
    """Called as the run's first folder and the tracker's id: Trackio continues a run by its name."""

    def __init__(self, folder: RunFolder, tracking: Tracking) -> None:
        self._run = trackio.init(
            tracking.project,
            f"{tracking.name}-{tracking.id}",
            config={**folder.settings(), "tags": list(tracking.tags)},
            resume="allow",
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )

    def log(self, values: dict[str, Any], env_steps: int) -> None:
        self._run.log(values, step=env_steps)

    def log_video(self, video: Path, env_steps: int) -> None:
        self._run.log({"video": trackio.Video(video)}, step=env_steps)

    def finish(self, summary: dict[str, Any]) -> None:
        numbers = {f"result/{name}": value for name, value in summary.items() if isinstance(value, int | float)}
        self._run.log(numbers, step=summary["env_steps"])
        self._run.finish()  # type: ignore[no-untyped-call]
