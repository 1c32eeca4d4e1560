"""A bus, and replay servers upon it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Bus
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.server import ReplayServer
from tests.replay_server.support import OPEN, SPEC, Make, close


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus()


@pytest.fixture
def make(tmp_path: Path, bus: MemoryBus) -> Iterator[Make]:
    """Servers in one folder unless another is named, closed at the end."""
    servers: list[ReplayServer] = []

    def build(config: ReplayConfig = OPEN, folder: str = "replay", actors: int = 2, total: int = 10**6,
              slack: int = 16, seed: int = 7, on: Bus | None = None) -> ReplayServer:  # fmt: skip
        servers.append(ReplayServer(SPEC, config, tmp_path / folder, seed, total, actors, slack, on or bus))
        return servers[-1]

    yield build
    for server in servers:
        close(server)
