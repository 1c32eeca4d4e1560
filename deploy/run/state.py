"""What became of a run: whether it is trained now, and how it ended."""

from typing import Literal

from rmc.common.errors import STOPPED_STATUS
from rmc.deploy.run.folder import RunFolder

State = Literal["new", "training", "finished", "stopped", "failed", "lost", "unknown"]


def run_state(folder: RunFolder) -> State:
    """Lost is one whose launcher was killed: it neither trains nor has ended. Raises ConfigError, OSError.

    Unknown is one whose lock its owner alone may read, as versions before made it.
    """
    try:
        return _locked_state(folder)
    except PermissionError:
        return "unknown" if folder.result() is None else "finished"


def remedy(folder: RunFolder) -> str:
    """What helps a run that has too little on record. Raises ConfigError, OSError."""
    if run_state(folder) == "failed" and (folder.logs / "launcher.log").exists():
        return "it failed, and logs/launcher.log says why"
    return "train it for longer"


def _locked_state(folder: RunFolder) -> State:
    if folder.lock.trainer() is not None:
        return "training"
    if folder.result() is not None:
        return "finished"
    status = folder.lock.ended()
    if status is not None:
        return "stopped" if status == STOPPED_STATUS else "failed"
    if folder.lock.lost():
        return "lost"
    return "stopped" if folder.metrics.exists() else "new"
