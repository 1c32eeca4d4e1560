"""What a run's Redis must know for its roles to begin: the config, and what the replay servers have counted."""

import time
from contextlib import suppress

from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusFull, BusUnavailable, RmcError
from rmc.deploy.redis.progress_backup import ProgressBackup
from rmc.deploy.run.config import RunConfig, to_registration
from rmc.deploy.run.folder import RunFolder

LOOK_SECONDS = 0.5  # less than a role takes to believe in a stop
KEPT_SECONDS = 3600  # in Redis, after the end


class Registration:
    """A run in its Redis, whoever's that is and however often it comes back empty."""

    def __init__(self, config: RunConfig, folder: RunFolder, bus: RedisBus) -> None:
        """Make the run known, afresh. Raises BusUnavailable, BusFull."""
        self._config, self._bus = to_registration(config), bus
        self._look_at = 0.0
        bus.expire(None)
        bus.clear_stop()  # before the config, which roles that are started by hand may wait for
        self._progress_backup = ProgressBackup(folder, config.replay.replay_shards)  # tells of a damaged file
        self._publish()

    def change(self, config: RunConfig) -> None:
        """From now on roles begin with this config. Raises BusUnavailable, BusFull."""
        changed = to_registration(config)
        self._bus.set_config(changed)
        self._config = changed

    def tend(self) -> None:
        """Look now and then whether Redis still knows, and copy what is counted; while it is away, nothing.

        One that came back with an earlier start's config also has the stop that ended that start.
        """
        if time.monotonic() >= self._look_at:
            self._look_at = time.monotonic() + LOOK_SECONDS
            with suppress(BusUnavailable, BusFull):
                known = self._bus.config()
                if known is not None and known != self._config:
                    self._bus.clear_stop()
                if known != self._config:
                    self._publish()
        self._progress_backup.keep(self._bus)

    def end(self) -> None:
        """Copy what is counted, at once, if that can be had; a run's end must not fail for it.

        A Redis is not left full of runs that are over; what they need to go on is in their folders.
        """
        with suppress(RmcError):
            self._progress_backup.keep(self._bus, at_once=True)
            self._bus.expire(KEPT_SECONDS)

    def _publish(self) -> None:
        """The counters first: a replay server that finds the config goes on from them."""
        self._progress_backup.restore(self._bus)
        self._bus.set_config(self._config)
