"""The runs in a folder and below it: what became of each, how far it came, how good it is."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table
from rich.text import Text

from rmc.analysis.run_paths import run_folders
from rmc.common.bus.metrics_record import is_complete
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.figures import duration, known_return, number
from rmc.deploy.monitor.recorded import recorded_status
from rmc.deploy.monitor.table import STYLES, plain_table
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import LISTED_BYTES, wall_seconds

DAMAGED = "damaged"
# Each column, and the console's width from which it is shown.
COLUMNS = {"run": 0, "state": 0, "steps": 0, "return": 0, "best": 60, "done": 72, "time": 84, "env": 110, "agent": 130}


@dataclass(frozen=True)
class RunSummary:
    """One run; of a damaged one its ``run`` and ``fault`` alone. ``eval_return`` is the newest, or the result's."""

    run: str
    state: str = DAMAGED
    env: str | None = None
    agent: str | None = None
    seed: int | None = None
    env_steps: int | None = None
    total_steps: int | None = None
    eval_return: float | None = None
    best_return: float | None = None
    elapsed_s: float | None = None
    fault: str | None = None


def runs(folder: Path) -> list[RunSummary]:
    """All of them, by name. Raises ConfigError where the folder cannot be read, or holds none."""
    if not folder.is_dir():
        raise ConfigError("FOLDER", str(folder), "is no folder; give one that holds runs")
    summaries = sorted(map(summary, run_folders(folder)), key=lambda one: one.run)
    if not summaries:
        raise ConfigError("FOLDER", str(folder), "holds no run; rmc train makes one, in runs/ unless told otherwise")
    return summaries


def summary(path: Path) -> RunSummary:
    """What is known of a run; that it is damaged, where it cannot be read."""
    folder = RunFolder(path)
    try:
        status, result = recorded_status(folder, LISTED_BYTES), folder.result() or {}
        elapsed = result.get("wall_s", status.elapsed_s)
        if elapsed is None:  # many actors have spoken since its launcher
            elapsed = wall_seconds(folder.metrics) or None
    except (ConfigError, OSError) as error:
        return RunSummary(str(path), fault=str(error))
    returns = [status.last.return_mean] if status.last is not None else []
    returns += [result["eval_return_mean"]] if result else []
    best = [status.best.return_mean] if status.best is not None else []
    best += [result["eval_return_mean"]] if result and is_complete(result) else []
    return RunSummary(
        str(path),
        str(status.state),
        status.env,
        status.preset,
        status.seed,
        result.get("env_steps", status.env_steps),
        status.total_steps,
        returns[-1] if returns else None,
        max(best, default=None),
        elapsed,
    )


def table(summaries: Sequence[RunSummary], folder: Path, width: int) -> Table:
    """A row for each, with as many columns as there is room for; names are relative to ``folder``."""
    shown = [name for name, least in COLUMNS.items() if width >= least]
    drawn = plain_table(shown, ("steps", "return", "best", "done", "time"))
    for one in summaries:
        cells = _cells(one, folder)
        drawn.add_row(*(cells[name] for name in shown))
    return drawn


def _cells(one: RunSummary, folder: Path) -> dict[str, str | Text]:
    done = min(1.0, one.env_steps / one.total_steps) if one.env_steps is not None and one.total_steps else None
    name = os.path.relpath(one.run, folder)
    return {
        "run": name if name != os.curdir else Path(one.run).resolve().name,
        "state": Text(one.state, STYLES.get(one.state, "red")),
        "steps": number(one.env_steps, ","),
        "return": known_return(one.eval_return),
        "best": known_return(one.best_return),
        "done": number(done, ".0%"),
        "time": duration(one.elapsed_s),
        "env": one.env or number(None),
        "agent": f"{one.agent} · {one.seed}" if one.agent else number(None),
    }
