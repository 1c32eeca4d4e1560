"""The learner's process."""

import ssl
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import torch

from rmc.common.bus.protocol import Bus
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.process.role import run_role
from rmc.common.replay import Replay
from rmc.deploy.local.role_context import RoleContext, RunConnection, until_taken
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.host import cores
from rmc.deploy.run.preflight import check_device, thread_choices, two_processes
from rmc.learner.learner import Learner
from rmc.learner.replay.client import ReplayClient
from rmc.learner.replay.sharded import ShardedReplay


def run_learner(connection: RunConnection, folder: Path, device: str) -> int:
    """The learner's process; checkpoints go to ``folder``. Its last record says ``finished`` where the run is."""
    secret, process = connection.secret(), RoleContext(connection)
    config, spec, bus = process.config, process.config.window_spec(), process.bus
    torch.set_num_threads(1)  # until it is known whether the model's half has a process, and what is fastest
    check_device(device)
    pinned, batch = device.startswith("cuda"), config.learner.batch_size
    context = tls.client_context(connection.tls_folder) if connection.tls_folder is not None else None
    clients = replay_clients(config, bus, secret, pinned, context)
    replay = clients[0] if len(clients) == 1 else ShardedReplay(clients, spec, batch, config.seed, pinned)
    with process.starting(Learner.name):
        threads, split = thread_choices(config, cores(), device), two_processes(config, cores(), device)
        learner = make_learner(config, replay, bus, folder, device, threads, split)
    run_role(learner, bus, process.stop, lambda: learner.finished)
    for client in clients:
        client.close()
    if learner.finished:
        last = {**learner.metrics(), "finished": 1}
        with suppress(BusUnavailable, BusFull):  # its launcher waits for it, unless all is to stop
            until_taken(lambda: bus.emit(learner.name, last), learner.name, process.stop)
        return 0
    return process.stop.exit_status


def make_learner(
    config: RunConfig, replay: Replay, bus: Bus, folder: Path, device: str, threads: Sequence[int], two_processes: bool
) -> Learner:
    """A run's learner, whose checkpoints lie in ``folder``; ``threads`` and ``two_processes`` as Learner takes them."""
    checkpoints = CheckpointFolder(folder, config.learner.keep_checkpoints)
    return Learner(
        config.window_spec(), config.agent, config.update, config.learner, replay, bus, checkpoints, config.seed,
        device, config.policy_header(), threads, two_processes,
    )  # fmt: skip


def replay_clients(
    config: RunConfig, bus: RedisBus, secret: bytes, pinned: bool, context: ssl.SSLContext | None
) -> list[ReplayClient]:
    """A client of each replay server. What one draws is its part of a batch, where there are several."""
    spec, part = config.window_spec(), max(1, config.learner.batch_size // config.replay.replay_shards)
    addresses = [partial(bus.replay_address, shard.role) for shard in config.shards()]
    return [ReplayClient(address, secret, spec, part, pinned, context) for address in addresses]
