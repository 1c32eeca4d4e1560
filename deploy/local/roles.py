"""Each role as a process: reads the run's config from Redis, builds the role from its part, runs its loop."""

import logging
import os
import ssl
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import torch

from rmc.actors.actor import Actor
from rmc.actors.evaluator import Evaluator
from rmc.common.bus.protocol import Bus
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.outage import Outage
from rmc.common.process.role import RECONNECT_SLEEP, Role, StopSignal, run_role
from rmc.common.process.watchdog import Watchdog
from rmc.common.shard import Shard
from rmc.deploy.local.role_environment import SECRET_VARIABLE
from rmc.deploy.redis.connect import PATIENCE_SECONDS, PATIENCE_VARIABLE, Patience, connect
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig, from_json
from rmc.deploy.run.preflight import check_device, cores
from rmc.learner.initial_priority import InitialPriority
from rmc.learner.learner import Learner
from rmc.learner.replay_client import ReplayClient
from rmc.learner.sharded_replay import ShardedReplay
from rmc.replay_server.process import ReplayProcess
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer

EVALUATOR_NICENESS = 10  # it must not take the learner's core
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Place:
    """Where a role finds its run."""

    run: str
    redis_url: str = field(repr=False)
    given_secret: str = field(repr=False, default="")
    secret_file: Path | None = None
    tls_folder: Path | None = None

    def secret(self) -> bytes:
        """The run's secret, from its file or as it was given. Raises ConfigError."""
        if self.secret_file is None:
            secret = self.given_secret.encode()
        else:
            try:
                secret = self.secret_file.read_bytes().strip()
            except OSError as error:
                raise ConfigError(
                    "--secret-file", str(self.secret_file), f"cannot be read ({error.strerror})"
                ) from None
        if not secret:
            raise ConfigError(
                "--secret-file", None, f"give the file secret of the run's folder, or set {SECRET_VARIABLE}"
            )
        return secret


class Process:
    """What every role's process has: stop signal, bus, the run's config."""

    def __init__(self, place: Place) -> None:
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
        self.stop = StopSignal()
        self.stop.install()
        patience = float(os.environ.get(PATIENCE_VARIABLE, PATIENCE_SECONDS))
        self.bus = connect(place.redis_url, place.run, Patience(patience, self.stop))
        self.config = self._registered_config(place.run, Patience(patience, self.stop))

    def _registered_config(self, run: str, waits: Patience) -> RunConfig:
        """The run's config; a Redis that has just come back empty gets it again within moments."""
        while True:
            with suppress(BusUnavailable):
                if (raw := self.bus.config()) is not None:
                    return from_json(raw)
            if not waits.on(f"run {run} to be registered in that Redis"):
                raise ConfigError("--run", run, "no run of this name is registered in that Redis; start it first")

    def make_env(self) -> Env:
        """A new environment of the run."""
        return make_env(self.config.env)


def wait_for_room(bus: Bus, role: str, stop: StopSignal) -> None:
    """Until Redis takes what this role writes, or it is stopped: one that begins amid an outage waits as others do."""
    outage = Outage(role)
    while not stop.requested:
        try:
            bus.check_room(role)
        except (BusUnavailable, BusFull) as error:
            outage.note(error)
            time.sleep(RECONNECT_SLEEP)
        else:
            outage.over()
            return


def run_actor(place: Place, index: int) -> None:
    """The process of actor ``index``."""
    process = Process(place)
    config = process.config
    if not 0 <= index < config.actors:
        raise ConfigError("--index", index, f"the run has actors 0 to {config.actors - 1}")
    wait_for_room(process.bus, f"actor-{index}", process.stop)
    torch.set_num_threads(1)
    spec, rater = config.window_spec(), initial_priority(config, index)
    actor = Actor(index, config.seed, process.make_env, spec, config.agent, config.actor, process.bus, rater=rater)
    _run_watched(actor, process)


def initial_priority(config: RunConfig, index: int) -> InitialPriority | None:
    """What rates the windows of an actor, where actors do."""
    if config.agent.initial_priority == "max":
        return None
    return InitialPriority(config.window_spec(), config.agent, config.update, config.seed + index)


def run_evaluator(place: Place) -> None:
    """The evaluator's process."""
    process = Process(place)
    config = process.config
    wait_for_room(process.bus, "evaluator", process.stop)
    torch.set_num_threads(1)
    os.nice(EVALUATOR_NICENESS)
    evaluator = Evaluator(config.seed, process.make_env, config.agent, config.evaluator, process.bus)
    _run_watched(evaluator, process)


def _run_watched(role: Role, process: Process) -> None:
    """A role that dies where an environment hangs; Redis may hang."""
    watchdog = Watchdog(process.config.env.env_timeout)
    process.bus.around = watchdog.asleep
    run_role(role, process.bus, process.stop, beat=watchdog.beat)
    watchdog.close()


def run_replay(place: Place, folder: Path, listen: str, index: int) -> None:
    """A replay server's process; its ring lies in ``folder``, its socket at ``listen``."""
    secret, process = place.secret(), Process(place)
    config, spec = process.config, process.config.window_spec()
    shard = Shard(index, config.replay.replay_shards)
    if not 0 <= index < shard.count:
        raise ConfigError("--shard", index, f"the run has replay servers 0 to {shard.count - 1}")
    wait_for_room(process.bus, shard.role, process.stop)
    torch.set_num_threads(1)
    server = ReplayServer(
        spec, config.replay, folder, config.seed, config.total_steps, config.actors, config.slack_steps(), process.bus,
        shard,
    )  # fmt: skip
    context = tls.server_context(place.tls_folder) if place.tls_folder is not None else None
    sockets = SocketServer(server, spec, listen, secret, config.learner.batch_size, context)
    process.bus.announce_replay(server.holder, sockets.address)
    run_role(ReplayProcess(server, sockets), process.bus, process.stop)


def run_learner(place: Place, folder: Path, device: str) -> None:
    """The learner's process; checkpoints go to ``folder``. Its last record says ``finished`` where the run is."""
    secret, process = place.secret(), Process(place)
    config, spec, bus = process.config, process.config.window_spec(), process.bus
    torch.set_num_threads(config.learner.threads or max(1, cores() - 1))
    check_device(device)
    wait_for_room(bus, Learner.name, process.stop)
    pinned, batch = device.startswith("cuda"), config.learner.batch_size
    context = tls.client_context(place.tls_folder) if place.tls_folder is not None else None
    clients = replay_clients(config, bus, secret, pinned, context)
    replay = clients[0] if len(clients) == 1 else ShardedReplay(clients, spec, batch, config.seed, pinned)
    checkpoints = CheckpointFolder(folder, config.learner.keep_checkpoints)
    learner = Learner(spec, config.agent, config.update, config.learner, replay, bus, checkpoints, config.seed, device)
    run_role(learner, bus, process.stop, lambda: learner.finished)
    for client in clients:
        client.close()
    if learner.finished:
        bus.emit(learner.name, {"time": time.time(), **learner.metrics(), "finished": 1})


def replay_clients(
    config: RunConfig, bus: RedisBus, secret: bytes, pinned: bool, context: ssl.SSLContext | None
) -> list[ReplayClient]:
    """A client of each replay server. What one draws is its part of a batch, where there are several."""

    def address_of(role: str) -> Callable[[], str | None]:
        def address() -> str | None:
            found = bus.replay_address(role)
            return found.address if found else None

        return address

    count = config.replay.replay_shards
    part = max(1, config.learner.batch_size // count)
    roles = [Shard(index, count).role for index in range(count)]
    return [ReplayClient(address_of(role), secret, config.window_spec(), part, pinned, context) for role in roles]
