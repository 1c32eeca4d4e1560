"""The replay server as a process: intake from the bus and the learner's socket in one thread."""

import time
from typing import Any

from common.bus import ReplayAddress
from common.errors import BusFull, BusUnavailable
from common.role import RECONNECT_SLEEP
from replay_server.server import ReplayServer
from replay_server.socket_server import SocketServer

IDLE_WAIT = 0.002  # seconds between looks at the bus while nothing comes in
ANNOUNCE_PERIOD = 5.0  # seconds between repeats of the address, in case Redis lost its data


class ReplayProcess:
    """The role ``replay`` with its socket. The learner is served on while Redis is away."""

    name = "replay"

    def __init__(self, server: ReplayServer, sockets: SocketServer) -> None:
        self.server, self.sockets = server, sockets
        self._next_intake = self._next_announcement = 0.0
        self._bus_is_away = False

    def step(self) -> bool:
        """Serve clients that are ready, then take in a round; waits for clients a little where neither had anything."""
        now = time.monotonic()
        due = now >= self._next_intake
        served = self.sockets.poll(0.0 if due else min(self._next_intake - now, IDLE_WAIT))
        took = due and self._take_in(now)
        return served or took

    def _take_in(self, now: float) -> bool:
        try:
            took = self.server.step()
            if now >= self._next_announcement:
                self._next_announcement = now + ANNOUNCE_PERIOD
                self.server.bus.announce_replay(ReplayAddress(self.server.epoch, self.sockets.address))
        except (BusUnavailable, BusFull):
            self._bus_is_away, self._next_intake = True, now + RECONNECT_SLEEP
            return False
        self._bus_is_away, self._next_intake = False, now + (0.0 if took else IDLE_WAIT)
        return took

    def waiting_for(self) -> str:
        """``redis``, or what the server waits for."""
        return "redis" if self._bus_is_away else self.server.waiting_for()

    def metrics(self) -> dict[str, Any]:
        """The server's, and how many clients the socket refused."""
        return {**self.server.metrics(), "refused_clients": self.sockets.refused.total()}

    def close(self) -> None:
        """Close the socket, then the server."""
        self.sockets.close()
        self.server.close()
