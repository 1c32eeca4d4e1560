"""``rmc list`` and ``rmc stop`` with ``--ray-address``: the runs that are trained on a Ray cluster."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict

from rich.table import Table

from rmc.common.errors import ConfigError
from rmc.deploy.monitor.figures import duration, number
from rmc.deploy.monitor.table import plain_table
from rmc.deploy.monitor.view import terminal
from rmc.deploy.ray import cluster_runs, launcher
from rmc.deploy.ray.launcher_actor import ClusterRunSummary


def list_runs(address: str, as_json: bool) -> int:
    with _joined(address):
        summaries = cluster_runs.summaries()
    if as_json:
        lines = [{"run": name} | (asdict(one) if one else {}) for name, one in summaries.items()]
        terminal().print(json.dumps(lines), soft_wrap=True)
    else:
        terminal().print(_table(summaries) if summaries else "no run is trained on this cluster")
    return 0


def stop(run: str, address: str) -> int:
    with _joined(address):
        summary = cluster_runs.stop(run)
    terminal().print(f"{run} has ended; its folder is {summary.folder} on {summary.host}", soft_wrap=True)
    return 0


@contextmanager
def _joined(address: str) -> Iterator[None]:
    """Ray tells every driver on standard output what goes wrong in its cluster: none of it is ours, or JSON.

    Raises ConfigError where no cluster answers.
    """
    if address == "local":
        raise ConfigError(
            "--ray-address", address, "starts a cluster of its own, where no run is; give auto or HOST:PORT"
        )
    with redirect_stdout(sys.stderr), launcher.joined(address):
        yield


def _table(summaries: dict[str, ClusterRunSummary | None]) -> Table:
    headings = ("run", "env", "steps", "learner", "actors", "time", "folder")
    drawn = plain_table(headings, ("steps", "actors", "time"))
    for name, one in summaries.items():
        drawn.add_row(name, *(_cells(one) if one else ["its launcher does not answer"]))
    return drawn


def _cells(one: ClusterRunSummary) -> list[str]:
    trained_s = None if one.since is None else time.time() - one.since
    steps = number(one.env_steps, ",")
    return [one.env, steps, one.learner or "none", str(one.actors), duration(trained_s), f"{one.host}:{one.folder}"]
