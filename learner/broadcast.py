"""Weights on their way to those who act, or to those who evaluate."""

import time

from rmc.common.bus.protocol import Bus, Version

LOOK_SECONDS = 5.0  # between looks whether Redis still has them


class Broadcast:
    """The newest weights, sent again where an outage kept them back or a Redis that lost data has others, or none.

    Without them a new actor would wait, and a checkpoint would get no evaluation.
    """

    def __init__(self, bus: Bus, evaluate: bool = False) -> None:
        self._bus, self._evaluate = bus, evaluate
        self._newest: tuple[Version, bytes] | None = None
        self._sent, self._look_at = True, 0.0

    def publish(self, version: Version, blob: bytes) -> None:
        """Raises FencedError, and BusUnavailable; then ``repeat_if_lost`` sends them."""
        self._newest, self._sent, self._look_at = (version, blob), False, time.monotonic() + LOOK_SECONDS
        self._bus.publish_weights(version, blob, self._evaluate)
        self._sent = True

    def repeat_if_lost(self) -> None:
        """Look in Redis now and then. Raises as ``publish``: at every call until an evaluation is asked for."""
        settled = self._sent or not self._evaluate  # updates go on without a Redis that only lacks what acts
        if self._newest is None or (settled and time.monotonic() < self._look_at):
            return
        self._look_at = time.monotonic() + LOOK_SECONDS
        if not self._sent or self._bus.latest_version(self._evaluate) != self._newest[0]:
            self.publish(*self._newest)
