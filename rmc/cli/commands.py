"""What each command of the command line does."""

import logging
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from rmc.cli import options, training
from rmc.cli.ending import say_end
from rmc.common.bus.redis_url import has_password, shown
from rmc.common.errors import ConfigError
from rmc.deploy.local.role_environment import SECRET_VARIABLE, URL_VARIABLE
from rmc.deploy.local.role_process import RunConnection
from rmc.deploy.monitor import attach as attachment
from rmc.deploy.monitor.view import RunStatus, table, terminal
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions

log = logging.getLogger(__name__)
Role = options.ActorRole | options.ReplayRole | options.LearnerRole | options.EvaluatorRole


def execute(command: options.Command) -> int:
    """Run a parsed command; its exit status. Raises RmcError."""
    given = RoleSecrets()
    if isinstance(command, options.Train | Role):
        _warn_of_password(command.redis_url or "")
    if isinstance(command, Role):
        return run_role(command, given)
    if type(command) in ACTIONS:
        return ACTIONS[type(command)](command)
    from rmc.cli import analysis_commands  # imports torch

    return analysis_commands.ACTIONS[type(command)](command)


def _warn_of_password(url: str) -> None:
    if has_password(url):
        fix = "write the URL to a file that only you may read, and give --redis-url file:PATH"
        log.warning("--redis-url=%r: everybody here can read its password in ps; %s", shown(url), fix)


class RoleSecrets:
    """What the environment told this process alone: taken out of it, before anything is started that would inherit."""

    def __init__(self) -> None:
        self.redis_url, self.secret = (os.environ.pop(name, "") for name in (URL_VARIABLE, SECRET_VARIABLE))


def train(command: options.Train) -> int:
    """Train a run."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    return training.train(command.config(), command.launch_options(), terminal())


def run_role(command: Role, given: RoleSecrets) -> int:
    """Be one role of a run until it ends."""
    url = command.redis_url or given.redis_url
    if not url:
        raise ConfigError("--redis-url", url, f"say where the run's Redis is, or set {URL_VARIABLE}")
    if isinstance(command, options.ActorRole | options.EvaluatorRole):
        from rmc.deploy.local import actor_process

        place = RunConnection(command.run, url)
        if isinstance(command, options.ActorRole):
            actor_process.run_actor(place, command.index)
        else:
            actor_process.run_evaluator(place)
        return 0
    place = RunConnection(command.run, url, given.secret, command.secret_file, command.tls_folder)
    if isinstance(command, options.ReplayRole):
        from rmc.deploy.local import replay_process

        replay_process.run_replay(place, command.folder, command.listen, command.shard)
    else:
        from rmc.deploy.local import learner_process

        learner_process.run_learner(place, command.folder, command.device)
    return 0


def stats(command: options.Stats) -> int:
    """Print the newest metrics of a run, and its result if it has one."""
    folder = RunFolder(command.run)
    config, result, console = folder.config(), folder.result(), terminal()
    board = RunStatus(config.env.id, config.preset, config.seed, config.total_steps, config.replay.replay_ratio)
    board.is_over = folder.trainer() is None
    for record in folder.records():
        board.take(record)
    if not board.roles:
        raise ConfigError("RUN", str(folder.path), "it has no metrics yet; train it first")
    console.print(table(board))
    if result is not None:
        console.print_json(data=result)
    return 0


def attach(command: options.Attach) -> int:
    """Watch a run until it ends, or until Ctrl-C."""
    folder, console = RunFolder(command.run), terminal()
    attachment.launcher_pid(folder)
    try:
        attachment.watch(folder, console, attachment.LauncherGone(folder))
    except KeyboardInterrupt:
        console.print(f"it goes on; rmc stop {command.run} ends it", soft_wrap=True)
        return 0
    return say_end(folder, console)


def stop(command: options.Stop) -> int:
    """End a run in order."""
    folder = RunFolder(command.run)
    attachment.stop(folder)
    if folder.is_baseline():  # its own terminal says how
        terminal().print(f"{folder.path} has ended", soft_wrap=True)
        return 0
    say_end(folder, terminal())
    return 0


def cluster(command: options.Cluster) -> int:
    """Bring a cluster up, or take it down."""
    from rmc.deploy.ray import machines  # needs what only the extra "ray" installs

    act = machines.up if command.action == "up" else machines.down
    act(command.config, terminal())
    return 0


def launch(command: options.LauncherRole) -> int:
    """Be the launcher of a run on Ray."""
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends it in order while no role is there yet, too
    folder = RunFolder(command.run)
    config = folder.config()
    folder.lock()
    launch_options = LaunchOptions(
        folder.path, "resume", "ray", command.device, None, command.ray_address, command.all_cpus, command.tls
    )
    return training.conduct(config, folder, launch_options, terminal(400))


ACTIONS: dict[type, Callable[[Any], int]] = {  # of all that start, watch or end a run
    options.Train: train,
    options.Stats: stats,
    options.Attach: attach,
    options.Stop: stop,
    options.Cluster: cluster,
    options.LauncherRole: launch,
}
