"""A run in MLflow: the server that ``MLFLOW_TRACKING_URI`` names, else ``mlflow.db`` in the working folder."""

import time
from pathlib import Path
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunData

from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.option_names import flat
from rmc.deploy.run.tracking import Tracking

ID = "rmc.id"  # the tag that tells a run from others of its name
STATES = {"finished": "FINISHED", "stopped": "KILLED"}
MOST_PARAMS = 100  # of one request


class MlflowRun:
    """Called as the run's folder. A start that finds a run with the tracker's id continues it."""

    def __init__(self, folder: RunFolder, tracking: Tracking) -> None:
        self._client = MlflowClient()
        there = self._client.get_experiment_by_name(tracking.project)
        experiment = there.experiment_id if there is not None else self._client.create_experiment(tracking.project)
        before = self._client.search_runs([experiment], f"tags.`{ID}` = '{tracking.id}'", max_results=1)
        if before:
            self._run = before[0].info.run_id
            self._client.update_run(self._run, status="RUNNING")
            self._tag_changes(before[0].data, flat(folder.config()))
            for tag in tracking.tags:
                self._client.set_tag(self._run, tag, "")
            return
        tags = {ID: tracking.id, **dict.fromkeys(tracking.tags, "")}
        self._run = self._client.create_run(experiment, run_name=folder.path.name, tags=tags).info.run_id
        params = [Param(name, str(value)) for name, value in flat(folder.config()).items()]
        for first in range(0, len(params), MOST_PARAMS):
            self._client.log_batch(self._run, params=params[first : first + MOST_PARAMS])

    def _tag_changes(self, told: RunData, options: dict[str, Any]) -> None:
        """What a resume has changed; a param of MLflow's is for good."""
        for name, value in options.items():
            if str(value) != told.tags.get(tag := f"resumed.{name}", told.params.get(name, str(value))):
                self._client.set_tag(self._run, tag, str(value))

    def log(self, values: dict[str, Any], env_steps: int) -> None:
        now = int(1e3 * time.time())
        self._client.log_batch(self._run, [Metric(name, value, now, env_steps) for name, value in values.items()])

    def log_video(self, video: Path, env_steps: int) -> None:
        self._client.log_artifact(self._run, str(video), f"videos/{env_steps}")

    def finish(self, summary: dict[str, Any]) -> None:
        numbers = {f"result/{name}": value for name, value in summary.items() if isinstance(value, int | float)}
        self.log(numbers, summary["env_steps"])
        self._client.set_terminated(self._run, STATES.get(summary["state"], "FAILED"))
