"""A run's Redis, the user's or one of its own, and what it must know of the run."""

from contextlib import ExitStack

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.process.role import StopSignal
from rmc.deploy.redis.connect import connect, tried_again
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.server import Port, RedisServer
from rmc.deploy.redis.socket_folder import SocketFolder
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder


class RunRedis:
    """Ready at once, gone at ``close``; the temporary folder of the run's sockets comes and goes with it.

    Without a ``url`` the run has a server of its own, which listens for other machines, too, where it has a ``port``.
    A ``stop`` ends its patience with a Redis that is away. Raises ConfigError, BusUnavailable, BusFull.
    """

    def __init__(
        self, config: RunConfig, folder: RunFolder, stop: StopSignal, url: str | None = None, port: Port | None = None
    ) -> None:
        self._folder, self._url = folder, url
        self._socket_folder = SocketFolder()
        self.sockets = self._socket_folder.path
        with ExitStack() as leave:
            leave.callback(self._socket_folder.close)
            self._server = None if url else RedisServer(self.sockets, port=port, users=self._users(config))
            if self._server is not None:
                leave.enter_context(self._server)
            self.bus: RedisBus = connect(self.url(LAUNCHER), folder.name)
            self._registration = tried_again(lambda: Registration(config, folder, self.bus), stop)
            self._leave = leave.pop_all()

    def _users(self, config: RunConfig) -> RedisUsers:
        return RedisUsers(self._folder.name, self._folder.secret(), config.roles())

    def url(self, role: str) -> str:
        """What a role on this machine connects to."""
        return self._url or self.server.url(role)

    @property
    def server(self) -> RedisServer:
        """The run's own."""
        assert self._server is not None
        return self._server

    def tend(self) -> None:
        """Start it again where it died, tell it of the run where it came back empty, copy what is counted.

        Raises RoleDied where its folder cannot be made again.
        """
        self._socket_folder.renew()
        if self._server is not None:
            self._server.tend()
        self._registration.tend()

    def change(self, config: RunConfig) -> None:
        """From now on roles begin with this config, new ones, too. Raises BusUnavailable, BusFull."""
        self._registration.change(config)
        self.server.admit(self._users(config))

    def end(self) -> None:
        """Copy what is counted, at once, if that can be had; a user's Redis keeps nothing of the run for long."""
        self._registration.end()

    def close(self) -> None:
        """End a server of its own; a user's stays as it is."""
        self._leave.close()
