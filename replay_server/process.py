"""The replay server as a process: intake from the bus and the learner's socket in one thread."""

import time
from typing import Any

from rmc.common.errors import BusFull, BusUnavailable
from rmc.common.process.malloc import keep_freed_memory
from rmc.common.process.role import RECONNECT_SLEEP
from rmc.replay_server.server import ReplayServer
from rmc.replay_server.socket_server import SocketServer

IDLE_WAIT = 0.02  # seconds between looks at the bus while nothing comes in: a look costs 0.3 ms
FIRST_WAIT = 0.0005  # until the first look after something came
# Seconds between repeats of the address, in case Redis lost its data, looks at which learner is the newest, and at the
# socket's file, which a cleaner of temporary files may take.
ANNOUNCE_PERIOD = 5.0


class ReplayProcess:
    """The role ``replay``, or a shard of it, with its socket.

    The learner is served on while Redis is away, and half of the time where it hangs.
    """

    def __init__(self, server: ReplayServer, sockets: SocketServer) -> None:
        keep_freed_memory()
        self.server, self.sockets, self.name = server, sockets, server.name
        self._next_intake = self._next_announcement = self._wait = 0.0
        self._bus_is_away = False

    def step(self) -> bool:
        """Take in a round if it is time to look, then serve clients; where there was neither, wait for either."""
        took = time.monotonic() >= self._next_intake and self._take_in()
        if self.sockets.poll() or took:
            return True
        wait = self._next_intake - time.monotonic()
        self.sockets.wait(min(max(wait, 0.0), IDLE_WAIT))
        return False

    def _take_in(self) -> bool:
        now = time.monotonic()
        try:
            took = self.server.step()
            if now >= self._next_announcement:
                self._next_announcement = now + ANNOUNCE_PERIOD
                self.sockets.stay_reachable()
                self.sockets.fence(self.server.bus.current_epoch("learner"))  # an older one may come to us first
                self.server.bus.announce_replay(self.server.owner, self.sockets.address)
        except (BusUnavailable, BusFull):
            self._bus_is_away, self._next_intake = True, time.monotonic() + RECONNECT_SLEEP
            return False
        self._wait = 0.0 if took else min(2 * self._wait + FIRST_WAIT, IDLE_WAIT)
        self._bus_is_away, self._next_intake = False, now + self._wait
        return took

    def waiting_for(self) -> str:
        """``redis``, or what the server waits for."""
        return "redis" if self._bus_is_away else self.server.waiting_for()

    def metrics(self) -> dict[str, Any]:
        """The server's, and how many clients the socket refused, also by reason."""
        refused = self.sockets.refused
        reasons = {f"refused_clients_{reason}": count for reason, count in refused.items()}
        return {**self.server.metrics(), "refused_clients": refused.total(), **reasons}

    def close(self) -> None:
        self.sockets.close()
        self.server.close()
