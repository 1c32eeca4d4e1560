"""Opens a run's folder: a new one, or one that goes on, with what may be other then."""

import logging
import os
import time
from contextlib import suppress
from itertools import count
from pathlib import Path

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError, ConfigError
from rmc.deploy.run.config import RunConfig, flat, option
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import IfExists

log = logging.getLogger(__name__)
MAY_CHANGE = {
    "total_steps",
    "actors",
    "env.env_timeout",
    "learner.threads",
    "learner.keep_checkpoints",
    "learner.checkpoint_steps",
    "evaluator.evaluation_seconds",
}


def open_run(config: RunConfig, run_dir: Path | None, if_exists: IfExists) -> RunFolder:
    """Make or take up a run's folder, locked. Raises ConfigError before anything is written where it may not be."""
    folder = RunFolder(run_dir or Path("runs") / _new_name(config))
    if os.fsencode(folder.path).decode(errors="replace") != str(folder.path):
        raise ConfigError("--run-dir", str(folder.path), "is no UTF-8; give another")
    if run_dir is None or if_exists == "new":
        folder = new_folder(folder.path)
    if (folder.path / "config.json").exists():
        if if_exists == "fail":
            raise ConfigError("--run-dir", str(folder.path), "is there already; use --if-exists resume or new")
        _check_resumable(folder, config)
    elif folder.path.exists() and (not folder.path.is_dir() or any(folder.path.iterdir())):
        raise ConfigError("--run-dir", str(folder.path), "is there and is no run's folder; give another one")
    make(folder)
    folder.lock()
    folder.reopen(config.total_steps)
    folder.write_config(config)
    folder.write_sizes(config.sizes())
    folder.secret()
    return folder


def _new_name(config: RunConfig) -> str:
    env = config.env.id.replace(":", "_").replace("/", "_")
    return f"{env}__{config.preset}__{config.seed}__{time.strftime('%Y%m%d-%H%M%S')}"


def new_folder(path: Path) -> RunFolder:
    """A folder of that name that was not there, or beside it: two starts in the same second get one each."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            with suppress(FileExistsError):
                folder = RunFolder(path if number == 1 else path.with_name(f"{path.name}-{number}"))
                folder.path.mkdir(0o700)
                break
    except OSError as error:
        raise _cannot_be_made(path, error) from None
    return folder


def _cannot_be_made(path: Path, error: OSError) -> ConfigError:
    return ConfigError("--run-dir", str(path), f"cannot be made ({error.strerror}); give another")


def make(folder: RunFolder) -> None:
    """Its folders, its owner's alone. Raises ConfigError."""
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        if not (folder.path / "config.json").exists():
            folder.path.chmod(0o700)  # what a later owner opens to others stays open
        for path in (folder.checkpoints, folder.logs):
            path.mkdir(exist_ok=True)
    except OSError as error:
        raise _cannot_be_made(folder.path, error) from None


def _check_resumable(folder: RunFolder, config: RunConfig) -> None:
    was, now = flat(folder.config()), flat(config)
    for path in ["env.id", "preset", *was]:
        if was[path] != now[path] and path not in MAY_CHANGE:
            name = "ENV" if path == "env.id" else option(path)
            fix = f"the run in {folder.path} has {was[path]!r}; use that, or another --run-dir"
            raise ConfigError(name, now[path], fix)
    folder.check_sizes(config.env.id, config.sizes())
    check_checkpoints(folder)


def check_checkpoints(folder: RunFolder) -> None:
    """Raises ConfigError where there are checkpoints but none is whole; damaged newer ones are told."""
    checkpoints = CheckpointFolder(folder.checkpoints)
    faults = []
    for number in reversed(checkpoints.numbers()):
        try:
            checkpoints.load(number)
        except CheckpointError as error:
            faults.append(str(error))
            continue
        for fault in faults:
            log.warning("%s; the run goes on from the checkpoint of update %d", fault, number)
        return
    if faults:
        raise ConfigError("--run-dir", str(folder.path), f"{faults[0]}; none is whole, so use another --run-dir")
