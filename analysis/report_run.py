"""A run as a report shows it: what it is, how far it is, its evaluations and records."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rmc.analysis import history
from rmc.analysis.doctor import examine
from rmc.analysis.history import About, History
from rmc.analysis.vitals import Record
from rmc.common.bus.metrics_record import is_finite
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.recorded import recorded_status
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.option_names import changes, flat
from rmc.deploy.run.presets import preset_config
from rmc.deploy.run.state import State, run_state

Series = tuple[list[float], list[float]]
DRAWN = {  # of a record; whole records of a long run do not fit in memory
    "role", "time", "wall_s", "start_s", "busy_share", "waiting_share", "waiting_for", "env_steps", "env_steps_per_s",
    "updates_per_s", "policy_lag_mean", "sample_age_mean", "stale_state_stored", "stale_state_burned",
}  # fmt: skip


@dataclass(frozen=True)
class ReportRun:
    """One run, read once."""

    folder: RunFolder
    name: str
    about: About
    history: History | None  # None before the first evaluation
    records: list[Record]  # what is drawn of them
    options: dict[str, Any]
    state: State
    env_steps: int  # so far

    @staticmethod
    def read(path: Path) -> "ReportRun":
        """From its folder, by whose name it is called. Raises ConfigError where it is none."""
        folder = RunFolder(path)
        about = history.describe(path)
        timed = (record for record in folder.records() if is_finite(record.get("time")))
        records = [{name: one[name] for name in DRAWN if name in one} for one in timed]  # no names of their own
        for record, seconds in zip(records, history.wall_seconds(records), strict=True):
            record["trained_s"] = seconds
        try:
            past = history.of_run(folder)
        except ConfigError:
            folder.result()  # damaged, it is an error; a missing evaluation is none
            past = None
        return ReportRun(
            folder,
            folder.path.name,
            about,
            past,
            records,
            flat(folder.settings()),
            run_state(folder),
            recorded_status(folder).env_steps,
        )

    @property
    def findings(self) -> list[str]:
        """What ``rmc doctor`` says; nothing of a baseline, or where there is too little to judge."""
        if self.folder.is_baseline():
            return []
        newest = MetricsTail(self.folder.metrics).take()
        return [str(finding) for finding in examine(newest, self.folder.config())]

    def changed(self) -> dict[str, list[Any]]:
        """Options that are not the preset's, with both values; not for a baseline, which has no preset."""
        config = self.folder.config()
        return changes(preset_config(config.preset, EnvConfig(config.env.id)), config)

    def series(self, kind: str, name: str) -> Series:
        """A metric over wall time (s), of the roles of a kind as each speaks; empty where nobody does.

        Several replay servers each collect a share of the agent steps.
        """
        of_kind = (record for record in self.records if record["role"].partition("-")[0] == kind)
        said = [record for record in of_kind if is_finite(record.get(name))]
        shares = self.options.get("replay.replay_shards", 1) if name == "env_steps_per_s" else 1
        return [one["trained_s"] for one in said], [float(shares * one[name]) for one in said]


def told_apart(runs: Sequence[ReportRun]) -> list[ReportRun]:
    """Each called by its path from the folder that holds them all."""
    base = os.path.commonpath([run.folder.path.parent for run in runs])
    return [replace(run, name=str(run.folder.path.relative_to(base))) for run in runs]
