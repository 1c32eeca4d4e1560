"""The process that follows a run's ``metrics.jsonl`` and hands it to a tracker, until its standard input ends.

Standard output carries what the user should know, a line each; whatever libraries print goes to its log.
"""

import json
import os
import select
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from rmc.common.bus.metrics_record import is_finite
from rmc.common.errors import first_line
from rmc.deploy.monitor.films import Films
from rmc.deploy.monitor.main_metrics import evaluation_metrics, main_metrics
from rmc.deploy.monitor.recorded import empty_status
from rmc.deploy.monitor.run_status import RunStatus
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.tracking import Tracking, kept_tracking

ROW_SECONDS = 10.0  # between rows
LOOK_SECONDS = 1.0
Notify = Callable[[str], None]


class TrackedRun(Protocol):
    """A run in a tracker. Its methods may raise anything."""

    def log(self, values: dict[str, Any], env_steps: int) -> None:
        """A row of numbers at an agent step."""

    def log_video(self, video: Path, env_steps: int) -> None:
        """An episode of the policy as it was at an agent step."""

    def finish(self, summary: dict[str, Any]) -> None:
        """Log the end, with ``env_steps``, and return when all has arrived."""


class _Nowhere:
    """In a tracker's place where films are all that is asked for."""

    def log(self, *_: Any, **__: Any) -> None: ...

    log_video = finish = log


def main() -> None:
    """The entry point: a run's folder, and from which byte of its metrics on."""
    output = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    folder, read_from = RunFolder(Path(sys.argv[1])), int(sys.argv[2])

    def notify(text: str) -> None:
        with suppress(OSError):  # the launcher has died
            output.write(" ".join(text.split()) + "\n")

    _notify_first_warning(notify)
    try:
        tracking = kept_tracking(folder.path)
        assert tracking is not None
        _follow(folder, _begin(folder, tracking, notify), read_from, Films(folder, tracking.video_every), notify)
    except Exception as error:
        notify(f"{first_line(error)}; the run goes on without it")
        raise


def _begin(folder: RunFolder, tracking: Tracking, notify: Notify) -> TrackedRun:
    match tracking.tracker:  # extras, and slow to import
        case "wandb":
            from rmc.deploy.monitor import wandb_run

            return wandb_run.WandbRun(folder, tracking, notify)
        case "trackio":
            from rmc.deploy.monitor import trackio_run

            return trackio_run.TrackioRun(folder, tracking)
        case "mlflow":
            from rmc.deploy.monitor import mlflow_run

            return mlflow_run.MlflowRun(folder, tracking)
        case "videos":
            return _Nowhere()


def _notify_first_warning(notify: Notify) -> None:
    """Of a library's, like that of a full disk; all are in the log."""
    shown = warnings.showwarning
    notified: list[Warning | str] = []

    def show(message: Warning | str, category: type[Warning], *where: Any) -> None:
        shown(message, category, *where)
        if not notified and issubclass(category, UserWarning):
            notified.append(message)
            notify(str(message))

    warnings.showwarning = show  # type: ignore[assignment]


def _follow(folder: RunFolder, run: TrackedRun, read_from: int, films: Films, notify: Notify) -> None:
    """A row now and then, one for each evaluation, films, and the end."""
    status, tail = empty_status(folder), MetricsTail(folder.metrics, read_from=read_from)
    due, end = time.monotonic() + ROW_SECONDS, None
    while end is None:
        end = _end_of_run()
        for record in tail.take():
            status.take(record)
            if values := evaluation_metrics(record):
                run.log(values, _at(status, record))
                films.take(record, _at(status, record))
        _log_film(films, run, notify)
        if time.monotonic() >= due or end is not None:
            due = time.monotonic() + ROW_SECONDS
            run.log(row(status), status.env_steps)
    films.close()
    if video := end.pop("video", None):
        run.log_video(Path(video), end.get("env_steps", status.env_steps))
    run.finish({"env_steps": status.env_steps} | end)


def _log_film(films: Films, run: TrackedRun, notify: Notify) -> None:
    film = films.finished()
    if film is not None and film.fault:
        notify(f"no {film.path.name}: {film.fault.removeprefix('rmc: ')}")
    elif film is not None:
        run.log_video(film.path, film.env_steps)


def _end_of_run() -> dict[str, Any] | None:
    """What the launcher says last, None while it says nothing; of one that was killed, that."""
    ready, _, _ = select.select([sys.stdin], [], [], LOOK_SECONDS)
    if not ready:
        return None
    ending = sys.stdin.read()
    return dict(json.loads(ending)) if ending else {"state": "lost"}


def _at(status: RunStatus, evaluation: dict[str, Any]) -> int:
    """Where the evaluated checkpoint stood, if that is known."""
    at = evaluation.get("eval_env_steps")
    return int(at) if is_finite(at) else status.env_steps


def row(status: RunStatus) -> dict[str, float]:
    """What is logged: the main metrics, and all of every role but single actors and the evaluator."""
    roles = {
        f"{role}/{name}": float(value)
        for role, record in status.roles.items()
        if not role.startswith(("actor-", "evaluator"))
        for name, value in record.items()
        if name != "time" and is_finite(value)
    }
    return main_metrics(status) | roles


if __name__ == "__main__":
    main()
