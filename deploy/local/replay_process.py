"""A replay server's process. Nothing here imports torch."""

from pathlib import Path

from rmc.common.bus.protocol import Bus, ReplayOwner
from rmc.common.errors import ConfigError
from rmc.common.process.role import run_role
from rmc.common.shard import Shard
from rmc.deploy.local.role_context import RoleContext, RunConnection
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.replay_server.process import ReplayProcess
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer


def make_server(config: RunConfig, folder: Path, bus: Bus, shard: Shard) -> ReplayServer:
    """A run's replay server, whose ring lies in ``folder``."""
    spec, slack = config.window_spec(), config.slack_steps()
    return ReplayServer(spec, config.replay, folder, config.seed, config.total_steps, config.actors, slack, bus, shard)


def drop_unread(bus: Bus, shard: Shard) -> None:
    """Remove what no replay server has taken: where that fills Redis, none could begin. Actors send it again."""
    owner = ReplayOwner(shard.role, bus.current_epoch(shard.role))
    for actor in filter(shard.owns, bus.actors()):
        bus.drop_stream(owner, actor)


def run_replay(connection: RunConnection, folder: Path, listen: str, index: int) -> int:
    """A replay server's process; its ring lies in ``folder``, its socket at ``listen``."""
    secret, process = connection.secret(), RoleContext(connection)
    config, shard = process.config, Shard(index, process.config.replay.replay_shards)
    if not 0 <= index < shard.count:
        raise ConfigError("--shard", index, f"the run has replay servers 0 to {shard.count - 1}")
    context = tls.server_context(connection.tls_folder) if connection.tls_folder is not None else None
    with process.starting(shard.role, lambda: drop_unread(process.bus, shard)):
        server = make_server(config, folder, process.bus, shard)
        sockets = SocketServer(server, listen, secret, config.learner.batch_size, context)
        process.bus.announce_replay(server.owner, sockets.address)
    run_role(ReplayProcess(server, sockets), process.bus, process.stop, idle_seconds=0.0)
    return process.stop.exit_status
