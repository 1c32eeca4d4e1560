"""Watching a run from outside its launcher, and ending it: by its folder alone, on the machine that holds that."""

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import ConfigError
from rmc.deploy.monitor.recorded import Callback, catch_up, empty_status, take_start
from rmc.deploy.monitor.view import View
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import MetricsTail
from rmc.deploy.run.starts import last_launch, resume_command
from rmc.deploy.run.state import run_state

LOOK_SECONDS = 0.2
AWAY_SECONDS = 30.0  # a launcher on Ray begins within that, and again where it was killed
STOP_SECONDS = 60.0


def watch(folder: RunFolder, console: Console, gone: Callable[[], bool], callback: Callback | None = None) -> None:
    """Show a run until its launcher ends, or is ``gone``.

    ``callback`` hears each record from now on.
    """
    config, tail = folder.config(), MetricsTail(folder.metrics)
    status = empty_status(folder, (*config.roles(), "launcher"))
    take_start(status, folder)
    catch_up(status, tail)
    view = View(status, console)
    try:
        while folder.lock.ended() is None and not gone():
            catch_up(status, tail, callback)
            time.sleep(LOOK_SECONDS)
    finally:
        catch_up(status, tail, callback)
        view.close(run_state(folder))


class LauncherGone:
    """Whether no launcher has trained a run for long."""

    def __init__(self, folder: RunFolder) -> None:
        self._folder, self._seen_at = folder, time.monotonic()

    def __call__(self) -> bool:
        if self._folder.lock.trainer() is not None:
            self._seen_at = time.monotonic()
        return time.monotonic() - self._seen_at > AWAY_SECONDS


def launcher_pid(folder: RunFolder) -> int:
    """The launcher's process. Raises ConfigError where nobody trains this run."""
    comes_back = folder.lock.ended() is None and last_launch(folder).launcher == "ray"  # or has not begun yet
    deadline = time.monotonic() + AWAY_SECONDS * comes_back
    while (trainer := folder.lock.trainer()) is None:
        if time.monotonic() >= deadline:
            folder.settings()
            over, more = ("it is finished", " --total-steps N") if folder.result() else ("nobody trains it now", "")
            raise ConfigError("RUN", str(folder.path), f"{over}; {resume_command(folder)}{more} continues it")
        time.sleep(LOOK_SECONDS)
    return trainer


def _ask(folder: RunFolder, trainer: int) -> None:
    """Tell the launcher to end. Raises ConfigError where it is another user's, or the folder names another process."""
    try:
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(trainer, 0)
            if folder.lock.is_held_by(trainer):
                os.kill(trainer, signal.SIGTERM)
            elif folder.lock.trainer() == trainer:
                fix = f"its .lock names process {trainer}, which does not train it; end the right one by hand"
                raise ConfigError("RUN", str(folder.path), fix)
    except PermissionError:
        fix = f"is trained by {_owner(trainer)} (process {trainer}); only they can stop it, or root"
        raise ConfigError("RUN", str(folder.path), fix) from None


def _owner(process: int) -> str:
    """Whose it is, by name."""
    try:
        return Path(f"/proc/{process}").owner()
    except (OSError, KeyError):  # hidden, or without a name
        return "another user"


def stop(folder: RunFolder) -> None:
    """Ask the launcher to end the run cleanly, and wait until it has. Raises ConfigError."""
    trainer = launcher_pid(folder)
    if elsewhere := folder.lock.trained_elsewhere():
        there = "its sweep" if folder.lock.is_on_ray() else "it there"
        raise ConfigError("RUN", str(folder.path), f"is trained on {elsewhere}; stop {there}")
    _ask(folder, trainer)
    seconds = STOP_SECONDS + CheckpointFolder(folder.checkpoints).patience(0.0)
    deadline = time.monotonic() + seconds
    while folder.lock.trainer() is not None:
        if time.monotonic() > deadline:
            raise ConfigError("RUN", str(folder.path), f"did not end within {seconds:.0f} s; see {folder.logs}")
        time.sleep(LOOK_SECONDS)
