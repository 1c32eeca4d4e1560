"""``rmc train --launcher ray``: hands a run to a launcher on the cluster's head, and watches it."""

import dataclasses
import os
import signal
from collections.abc import Callable
from contextlib import suppress

from rich.console import Console

from rmc.cli.ending import print_end
from rmc.cli.signals import signals_caught
from rmc.common.process.role import StopSignal
from rmc.deploy.monitor import attach
from rmc.deploy.monitor.recorded import Callback
from rmc.deploy.ray import launcher, placement
from rmc.deploy.redis.socket_folder import place_for_sockets
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.host import cores
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.memory_reach import reach_note
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.preflight import check_machine
from rmc.deploy.run.validation import validate, validate_launch


def train(
    config: RunConfig, options: LaunchOptions, console: Console, callback: Callback | None
) -> tuple[RunFolder, int]:
    """Hand a run to a launcher on the cluster's head, and watch it; the run's folder, and its exit status.

    Ctrl-C ends the run, a closed terminal only where the cluster is this process's own.
    """
    validate_launch(config, options)
    enough = max(cores(), placement.reserved_cpus(config) + config.actors)  # of a cluster of our own
    with launcher.joined(options.ray_address, enough):
        return _watched(config, options, console, callback)


def _watched(
    config: RunConfig, options: LaunchOptions, console: Console, callback: Callback | None
) -> tuple[RunFolder, int]:
    launcher.check_on_head()
    if options.run_dir is not None and options.if_exists != "new":
        launcher.check_not_there(RunFolder(options.run_dir))
    placement.check_room(config, options.device)
    fit = placement.actors_that_fit(config)
    learner = dataclasses.replace(config.learner, threads=placement.learner_cpus(config))
    config = dataclasses.replace(config, learner=learner, actors=fit if options.all_cpus else config.actors)
    validate(config)  # again: the cluster may have changed the number of actors
    check_machine(config, options)
    place_for_sockets()
    folder = open_run(config, options, launcher.check_not_there)
    with signals_caught(hangup=options.ray_address == "local") as stop:  # only a cluster of our own ends with us
        launcher.launch(config, folder)
        console.print(f"run folder {folder.path}", soft_wrap=True)
        if note := reach_note(config):
            console.print(note, soft_wrap=True)
        attach.watch(folder, console, _passes_on(stop, folder), callback)
        launcher.wait_gone(folder)
    return folder, print_end(folder, console)


def _passes_on(stop: StopSignal, folder: RunFolder) -> Callable[[], bool]:
    """Whether the run's launcher is gone; tells it to stop, once, when we are."""
    stopped: int | None = None  # which of the launchers, if it is started again

    def gone() -> bool:
        nonlocal stopped
        if stop.requested and (trainer := folder.lock.trainer()) not in (None, stopped):
            stopped = trainer
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(trainer, signal.SIGTERM)
        return not launcher.is_there(folder)

    return gone
