"""The runs that are trained on a cluster, listed and stopped from any of its nodes: their launchers are asked."""

import time
from contextlib import suppress
from typing import Any

import ray

from rmc.common.errors import ConfigError
from rmc.deploy.ray.launcher_actor import ClusterRunSummary
from rmc.deploy.ray.role_actor import NAMESPACE

ANSWER_SECONDS = 10.0  # of a launcher, which may be taking in a checkpoint
AWAY_SECONDS = 30.0  # a launcher that was killed begins again within that
LOOK_SECONDS = 0.5


def summaries() -> dict[str, ClusterRunSummary | None]:
    """Of every run by its name; None where its launcher does not answer, or cannot."""
    found: dict[str, ClusterRunSummary | None] = {}
    for name, launcher in sorted(_launchers().items()):
        found[name] = None
        with suppress(ConfigError):  # its folder is damaged
            found[name] = _asked(launcher.summary, ANSWER_SECONDS)
    return found


def stop(run: str) -> ClusterRunSummary:
    """End a run cleanly, and wait until it has; how far it was.

    Raises ConfigError, also of a run that it has asked to end where the run's folder is damaged.
    """
    name, launcher = _found(run)
    try:
        summary: ClusterRunSummary | None = _asked(launcher.summary, AWAY_SECONDS)
    except ConfigError:
        _asked(launcher.end, AWAY_SECONDS)
        raise
    seconds: float | None = _asked(launcher.end, AWAY_SECONDS)
    if summary is None or seconds is None:
        raise ConfigError("RUN", run, f"its launcher does not answer for {AWAY_SECONDS:.0f} s; try again")
    deadline = time.monotonic() + seconds
    while name in _launchers():
        if time.monotonic() > deadline:
            fix = f"did not end within {seconds:.0f} s; see {summary.folder}/logs on {summary.host}"
            raise ConfigError("RUN", run, fix)
        time.sleep(LOOK_SECONDS)
    return summary


def _launchers() -> dict[str, Any]:
    """Of all runs, by the run's name."""
    handles = {}
    for actor in ray.util.list_named_actors(all_namespaces=True):
        run, _, role = actor["name"].rpartition(":")
        if actor["namespace"] == NAMESPACE and role == "launcher":
            with suppress(ValueError):  # it has just ended
                handles[run] = ray.get_actor(actor["name"], NAMESPACE)
    return handles


def _found(run: str) -> tuple[str, Any]:
    """A run's name and launcher, by its name or by that of its folder where only one has such. Raises ConfigError."""
    launchers = _launchers()
    meant = [run] if run in launchers else [name for name in launchers if name.rpartition("-")[0] == run]
    if len(meant) == 1:
        return meant[0], launchers[meant[0]]
    there = ", ".join(sorted(meant or launchers)) or "none"
    problem = "is the name of several; give one of:" if meant else "is not trained on this cluster; its runs:"
    raise ConfigError("RUN", run, f"{problem} {there}")


def _asked(question: Any, seconds: float) -> Any:
    """What a launcher answers to it; None where there is no answer. Raises ConfigError where that is the answer."""
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        try:
            return ray.get(question.remote(), timeout=left)
        except ray.exceptions.ActorDiedError:
            return None
        except ray.exceptions.RayError as error:
            if isinstance(cause := getattr(error, "cause", None), ConfigError):
                raise cause from None
            time.sleep(LOOK_SECONDS)  # it is being started again
    return None
