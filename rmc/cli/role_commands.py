"""``rmc role``: this process is one role of a run."""

import dataclasses
import logging
import os
import sys

from rmc.cli import signals, training
from rmc.cli.role_options import ActorRole, EvaluatorRole, LauncherRole, ReplayRole, Role
from rmc.common.errors import ConfigError
from rmc.deploy.local.role_context import RunConnection
from rmc.deploy.local.role_environment import SECRET_VARIABLE, URL_VARIABLE
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.starts import last_launch


def run_role(command: Role) -> int:
    """Be one role of a run until it ends; its exit status."""
    # told to this process alone: taken out of the environment, before anything is started that would inherit it
    given_url, secret = (os.environ.pop(name, "") for name in (URL_VARIABLE, SECRET_VARIABLE))
    role = command.role
    if isinstance(role, LauncherRole):
        return launch(role)
    url = role.redis_url or given_url
    if not url:
        raise ConfigError("--redis-url", url, f"say where the run's Redis is, or set {URL_VARIABLE}")
    if isinstance(role, ActorRole | EvaluatorRole):
        return _play(role, RunConnection(role.run, url))
    connection = RunConnection(role.run, url, secret, role.secret_file, role.tls_folder)
    if isinstance(role, ReplayRole):
        from rmc.deploy.local import replay_process

        return replay_process.run_replay(connection, role.folder, role.listen, role.shard)
    from rmc.deploy.local import learner_process

    return learner_process.run_learner(connection, role.folder, role.device)


def _play(role: ActorRole | EvaluatorRole, connection: RunConnection) -> int:
    from rmc.deploy.local import actor_process

    if isinstance(role, ActorRole):
        return actor_process.run_actor(connection, role.index)
    return actor_process.run_evaluator(connection)


def launch(command: LauncherRole) -> int:
    """Be the launcher of a run on Ray."""
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
    signals.interrupt()  # SIGTERM ends it cleanly while no role is there yet, too
    folder = RunFolder(command.run)
    config = folder.config()
    launch_options = dataclasses.replace(last_launch(folder, "ray"), ray_address=command.ray_address)
    folder.lock.take()
    return training.conduct(config, folder, launch_options, terminal(400))
