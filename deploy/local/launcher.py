"""A run as processes of this machine: embedded Redis if none is given, roles under the supervisor, the monitor."""

import json
import logging
import time
from pathlib import Path

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import PROGRESS, CheckpointFolder
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.role import StopSignal
from rmc.deploy.local.role_command import (
    RoleCommand,
    actor_commands,
    evaluator_commands,
    learner_command,
    replay_command,
)
from rmc.deploy.local.role_environment import URL_VARIABLE
from rmc.deploy.local.supervisor import HELD_SECONDS, STOP_SECONDS, Supervisor
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.redis.connect import PATIENCE_VARIABLE, connect, tried_again
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.run_redis import RunRedis
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder

TICK_SECONDS = 0.2  # between looks at the roles and their metrics: a look costs 3 ms
OUTAGE_SECONDS = 86_400.0  # of a Redis that answered once, until a role that is started amid it gives up
log = logging.getLogger(__name__)


def commands(config: RunConfig, folder: RunFolder, sockets: Path, device: str) -> list[RoleCommand]:
    """How each role of the run is started here; the same commands start them by hand."""
    run, secrets = folder.name, ("--secret-file", str(folder.secret_file))
    replays = [
        replay_command(shard, run, str(folder.path / shard.role), f"unix:{sockets / shard.role}.sock", secrets)
        for shard in config.shards()
    ]
    learner = learner_command(run, str(folder.checkpoints), device, secrets)
    return [*replays, learner, *evaluator_commands(config, run), *actor_commands(config, run)]


class LocalRun:
    """A run's processes between ``start`` and ``close``."""

    def __init__(
        self, config: RunConfig, folder: RunFolder, redis_url: str | None, device: str, stop: StopSignal
    ) -> None:
        self._redis = RunRedis(config, folder, stop, redis_url)
        self.bus = self._redis.bus
        self.supervisor = Supervisor(
            commands(config, folder, self._redis.sockets, device),
            lambda role: {URL_VARIABLE: self._redis.url(role), PATIENCE_VARIABLE: str(OUTAGE_SECONDS)},
            folder.logs,
            lambda role: CheckpointFolder(folder.checkpoints).patience(HELD_SECONDS) if role == "learner" else 0.0,
            lambda: stop.requested,
        )

    def tend(self) -> None:
        """Start again what died: roles, and the embedded Redis. Raises RoleDied."""
        self._redis.tend()
        self.supervisor.tend()

    def finished(self) -> bool:
        """Whether the learner has ended cleanly."""
        return self.supervisor.roles["learner"].finished

    def close(self) -> None:
        """End everything; nothing is left but the run's folder."""
        try:
            self.supervisor.stop()
            self._redis.end()
        finally:
            self._redis.close()


def train(
    config: RunConfig, folder: RunFolder, redis_url: str | None, device: str, monitor: Monitor, stop: StopSignal
) -> bool:
    """Train until the total is reached or ``stop`` is set; whether it was reached. Raises RoleDied, ConfigError."""
    run = LocalRun(config, folder, redis_url, device, stop)
    monitor.restarts, total = run.supervisor.restarts, config.total_steps
    try:
        tried_again(lambda: monitor.skip_old(run.bus), stop)
        run.supervisor.start()
        while not stop.requested and not run.finished():
            run.tend()
            monitor.watch(run.bus)
            time.sleep(TICK_SECONDS)
        run.supervisor.stop()
        monitor.watch(run.bus)  # what the roles said last; a Redis that is away has lost it
        return is_over(monitor, folder, run.finished() and not stop.requested, total)
    finally:
        run.close()


def is_over(monitor: Monitor, folder: RunFolder, ended: bool, total: int) -> bool:
    """Whether the learner has said so or, where Redis has lost that, has ``ended`` unasked with the total saved."""
    return monitor.learner_finished() or (ended and saved_steps(folder) >= total)


def saved_steps(folder: RunFolder) -> int:
    """Agent steps of the newest checkpoint; 0 where there is none."""
    newest = CheckpointFolder(folder.checkpoints).latest()
    return int(json.loads(newest[1][PROGRESS])["env_steps"]) if newest else 0


def asked_to_stop(bus: RedisBus, reason: str) -> bool:
    """Whether Redis took it."""
    try:
        bus.request_stop(reason)
    except (BusUnavailable, BusFull):
        return False
    return True


def attend(config: RunConfig, folder: RunFolder, redis_url: str, monitor: Monitor, stop: StopSignal) -> bool:
    """Register a run whose roles are started by hand, watch it and end it; whether its total was reached."""
    bus = connect(redis_url, folder.name)
    registration = tried_again(lambda: Registration(config, folder, bus), stop)
    try:
        _watched(registration, folder, bus, monitor, stop)
    finally:
        registration.end()
    if monitor.learner_finished():
        _check_last(folder.checkpoints, monitor.status.get("learner", "checkpoint_update"))
    return monitor.learner_finished()


def _watched(registration: Registration, folder: RunFolder, bus: RedisBus, monitor: Monitor, stop: StopSignal) -> None:
    """Watch a run's roles to the end, and ask them to stop, whatever the end was."""
    reason, asked = "stopped by its launcher", False
    try:
        tried_again(lambda: monitor.skip_old(bus), stop)
        while not stop.requested and not monitor.learner_finished():
            registration.tend()
            monitor.watch(bus)
            time.sleep(TICK_SECONDS)
        reason = reason if stop.requested else "finished"
        deadline = time.monotonic() + CheckpointFolder(folder.checkpoints).patience(STOP_SECONDS)
        while (stop.requested or not asked) and time.monotonic() < deadline:
            asked = asked_to_stop(bus, reason) or asked  # again: a Redis may come back without it
            monitor.watch(bus)  # the learner saves; what it says then is still recorded
            time.sleep(TICK_SECONDS)
    finally:
        if not (asked or asked_to_stop(bus, reason)):
            log.warning("Redis took no request to stop; end the run's roles by hand")


def _check_last(checkpoints: Path, update: int | None) -> None:
    """Raises ConfigError where a learner on another machine has saved its last checkpoint in a folder of its own."""
    if update is not None and update not in CheckpointFolder(checkpoints).numbers():
        fix = (
            f"the learner's last checkpoint, of update {update}, is not there; bring its --folder here, then rmc resume"
        )
        raise ConfigError("checkpoints", str(checkpoints), fix)
