"""What every role's process has: where its run is, its bus, the run's config."""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, RmcError
from rmc.common.process.outage import OutageLog
from rmc.common.process.role import RECONNECT_SLEEP, StopSignal
from rmc.deploy.local.role_environment import SECRET_VARIABLE
from rmc.deploy.redis.connect import PATIENCE_SECONDS, PATIENCE_VARIABLE, Deadline, connect
from rmc.deploy.run.config import RunConfig, from_registration
from rmc.deploy.run.env_sizes import check_sizes, env_sizes

log = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True)
class RunConnection:
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


class RoleContext:
    """What every role's process has: stop signal, bus, the run's config."""

    def __init__(self, connection: RunConnection) -> None:
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
        self.stop = StopSignal()
        self.stop.install()
        patience = float(os.environ.get(PATIENCE_VARIABLE, PATIENCE_SECONDS))
        with self._unless_ended():
            self.bus = connect(connection.redis_url, connection.run, Deadline(patience, self.stop))
            self.config = self._registered_config(connection.run, Deadline(patience, self.stop))

    @contextmanager
    def _unless_ended(self) -> Iterator[None]:
        """A start that SIGTERM cuts short is no fault, and its launcher makes another. Raises SystemExit."""
        try:
            yield
        except RmcError:
            if self.stop.terminated:
                raise SystemExit(self.stop.exit_status) from None
            raise

    def _registered_config(self, run: str, waits: Deadline) -> RunConfig:
        """The run's config; a Redis that has just come back empty gets it again within moments."""
        while True:
            with suppress(BusUnavailable):
                if (raw := self.bus.config()) is not None:
                    self._check_goes_on(run)
                    return from_registration(raw)
            if not waits.wait(f"run {run} to be registered in that Redis"):
                raise ConfigError("--run", run, "no run of this name is registered in that Redis; start it first")

    def _check_goes_on(self, run: str) -> None:
        """A role that begins after the run's end would write what nobody removes. Raises SystemExit."""
        if (reason := self.bus.stop_requested()) is not None:
            log.warning("run %s has ended: %s", run, reason)
            raise SystemExit(0)

    @contextmanager
    def starting(self, role: str, make_room: Callable[[], None] = lambda: None) -> Iterator[None]:
        """Within it the role is made, once Redis takes what it writes. Outages are waited out, as when it runs.

        ``make_room`` is called before each new try where Redis has no memory left.
        """
        with self._unless_ended(), self.bus.repeated(lambda call: until_taken(call, role, self.stop, make_room)):
            self.bus.check_room(role)
            yield

    def make_env(self, privileged: bool = False) -> Env:
        """A new environment of the run, as ``make_env``. Raises ConfigError where its sizes are not the launcher's."""
        env = make_env(self.config.env, privileged=privileged)
        check_sizes(self.config.env.id, self.config.sizes(), env_sizes(env, self.config.env))
        return env


def until_taken(call: Callable[[], T], role: str, stop: StopSignal, make_room: Callable[[], None] = lambda: None) -> T:
    """Make a call of Redis until it is taken. Raises BusUnavailable, BusFull once the role is to stop."""
    outage = OutageLog(role)
    while True:
        try:
            answer = call()
        except (BusUnavailable, BusFull) as error:
            if stop.requested:
                raise
            outage.begin(error)
            time.sleep(RECONNECT_SLEEP)
            if str(error).startswith("OOM"):
                make_room()
        else:
            outage.end()
            return answer
