"""A replay server as a process of its own, for tests that kill it: URL RUN FOLDER CAPACITY."""

import sys
from pathlib import Path

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.process.role import StopSignal, run_role
from rmc.replay_server import stream_reader
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.process import ReplayProcess
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer
from tests.replay_server.support import SPEC

SECRET = b"the run's secret"
ACTORS = 2


def main(url: str, run: str, folder: Path, capacity: int) -> None:
    """Serve until SIGTERM."""
    stream_reader.MAX_ENTRIES = 8  # many small rounds, so that a kill falls amid them
    bus = RedisBus(url, run)
    config = ReplayConfig(capacity=capacity, replay_ratio=1e6, warmup_steps=0)
    server = ReplayServer(SPEC, config, folder / "replay", 1, 10**9, ACTORS, 10**6, bus)
    sockets = SocketServer(server, f"unix:{folder}/r.sock", SECRET, 64)
    stop = StopSignal()
    stop.install()
    run_role(ReplayProcess(server, sockets), bus, stop, idle_seconds=0.0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))
