"""Sees from outside what is acknowledged and which weights are the newest, all the time."""

import threading
import time
from contextlib import suppress
from itertools import pairwise

from rmc.common.bus.protocol import EntryId, Version
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import BusUnavailable
from tests.faults.judge import Acks, newest

LOOK_SECONDS = 0.005


class Witness:
    """Of a run of so many actors. It looks between ``start`` and ``stop``, in a thread, while Redis answers."""

    def __init__(self, actors: int) -> None:
        self.acks: Acks = {}
        self.acks_went_back = 0
        self.versions: list[Version] = []  # of the weights, as they were seen
        self._before = [EntryId(0, 0)] * actors
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, bus: RedisBus) -> None:
        """Look through a bus that is its own."""
        self._thread = threading.Thread(target=self._look_on, args=(bus,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Look no more."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()

    def redis_came_back(self) -> None:
        """It may know less than before: what is seen from now on is not compared with what was."""
        self._before = [EntryId(0, 0)] * len(self._before)
        self.versions.clear()

    def _look_on(self, bus: RedisBus) -> None:
        while not self._over.is_set():
            with suppress(BusUnavailable):
                self._look(bus)
            time.sleep(LOOK_SECONDS)

    def _look(self, bus: RedisBus) -> None:
        before = self._before
        for actor in range(len(before)):
            ack = bus.ack(actor)
            if ack is not None:
                self.acks_went_back += before is self._before and ack.id < before[actor]  # else it is another Redis's
                before[actor] = ack.id
                newest(self.acks, actor, ack.id)
        version = bus.latest_version()
        if version is not None and [version] != self.versions[-1:]:
            self.versions.append(version)


def went_back(versions: list[Version]) -> int:
    """How often weights were older than those seen before."""
    return sum(later < earlier for earlier, later in pairwise(versions))
