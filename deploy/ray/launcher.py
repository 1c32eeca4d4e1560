"""A run's launcher on a Ray cluster, from outside: joining the cluster, starting a launcher there, finding one."""

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import ConfigError, first_line, last_line
from rmc.deploy.local.role_command import launcher_command
from rmc.deploy.local.role_environment import working_folder
from rmc.deploy.local.supervisor import HELD_SECONDS
from rmc.deploy.ray.head import check_head
from rmc.deploy.ray.launcher_actor import LauncherActor
from rmc.deploy.ray.role_actor import NAMESPACE, Task, actor_name
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import users_path

BEGIN_SECONDS = 60.0  # of the launcher's host
CLOSE_SECONDS, LOOK_SECONDS = 10.0, 0.2  # for it to end, and between looks


@contextmanager
def joined(address: str, cpus: int | None = None) -> Iterator[None]:
    """In a cluster as a driver; ``local`` starts one for this process alone. Raises ConfigError."""
    quiet: dict[str, Any] = {"namespace": NAMESPACE, "log_to_driver": False, "logging_level": logging.ERROR}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    mask = os.umask(0o077)  # Ray may write its token, and lets everyone read it
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        if address == "local":
            ray.init(address="local", num_cpus=cpus, include_dashboard=False, **quiet)
        else:
            check_head(address)
            ray.init(address=address, **quiet)
    except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        fix = (
            f"no Ray cluster answers ({first_line(error)}); start one with ray start --head; rmc train takes local, too"
        )
        raise ConfigError("--ray-address", address, fix) from None
    except SystemExit:  # Ray's own handler of SIGTERM
        raise KeyboardInterrupt from None
    finally:
        os.umask(mask)
        for number, handler in handlers.items():  # Ray takes SIGTERM for itself
            if handler is not None:  # not set from Python
                signal.signal(number, handler)
    try:
        yield
    finally:
        ray.shutdown()


def check_on_head() -> None:
    """Raises ConfigError where this node is not the cluster's head."""
    head = next((node for node in ray.nodes() if "node:__internal_head__" in node["Resources"]), None)
    if head is None or head["NodeID"] != ray.get_runtime_context().get_node_id():
        raise ConfigError(
            "--launcher", "ray", "this is not the cluster's head; run it there, by ray attach or ray exec"
        )


def launch(config: RunConfig, folder: RunFolder) -> None:
    """Start the launcher of a locked run on this node, which must be the head; unlocks it. Raises ConfigError."""
    try:
        host = _created(config, folder)
    finally:
        folder.lock.release()  # for the launcher: another start finds the actor's name
    try:
        ray.get(host.numbers.remote(), timeout=BEGIN_SECONDS)
    except BaseException as error:  # a closed terminal, too
        ray.kill(host, no_restart=True)  # it must not begin once nobody expects it
        if not isinstance(error, ray.exceptions.RayError):
            raise
        fix = f"the run's launcher could not begin on the head ({last_line(error)})"
        raise ConfigError("--launcher", "ray", fix) from None


def _created(config: RunConfig, folder: RunFolder) -> Any:
    context = ray.get_runtime_context()
    for file in (tls.CERTIFICATE, tls.KEY):  # for the address that the head has now
        (folder.path / file).unlink(missing_ok=True)
    command = launcher_command(str(folder.path), context.gcs_address)
    actor = ray.remote(LauncherActor).options(
        name=actor_name(folder.name, "launcher"), namespace=NAMESPACE, lifetime="detached", max_restarts=-1, num_cpus=0,
        scheduling_strategy=NodeAffinitySchedulingStrategy(context.get_node_id(), soft=False),
    )  # fmt: skip
    task = Task(folder.name, command, users_path(), {}, working_folder())
    try:
        return actor.remote(task, str(folder.path), config.learner.keep_checkpoints)
    except ValueError:  # another has the name
        raise _is_trained(folder) from None


def check_not_there(folder: RunFolder) -> None:
    """Raises ConfigError where the run has a launcher, if only one that is being started again."""
    if folder.secret_file.exists() and is_there(folder):  # asking one that has never begun would make one
        raise _is_trained(folder)


def _is_trained(folder: RunFolder) -> ConfigError:
    return ConfigError("--run-dir", str(folder.path), "this run is being trained; rmc attach watches it")


def wait_gone(folder: RunFolder) -> None:
    """Until the launcher's host has ended what its launcher left: the learner may still save."""
    deadline = time.monotonic() + CheckpointFolder(folder.checkpoints).patience(HELD_SECONDS) + CLOSE_SECONDS
    while is_there(folder) and time.monotonic() < deadline:
        time.sleep(LOOK_SECONDS)


def is_there(folder: RunFolder) -> bool:
    """Whether the run's launcher has a host."""
    try:
        ray.get_actor(actor_name(folder.name, "launcher"), NAMESPACE)
    except ValueError:
        return False
    return True
