"""Finds the windows of an episode again, from one of them back to its start."""

import numpy as np

from rmc.common.window import Slots
from rmc.replay_server.ring import Ring

CHUNK = 1024  # serials looked through at once
FARTHEST = 65_536  # serials looked through at most: the learner waits for its next batch meanwhile


def find_episode(ring: Ring, serial: int, most: int) -> Slots | None:
    """Slots of the windows from the start of an episode to the one with that serial, oldest first.

    None where one of them was evicted or refused, or where there are more than ``most``. An actor's windows of one
    environment lie in the ring in the order of time, those of others between them.
    """
    progress, rows = ring.progress, ring.rows
    if not (progress.valid_from <= serial < progress.next_serial and ring.holds(np.array([serial])).all()):
        return None
    chain = [serial % ring.capacity]
    origin = {name: rows[name][chain[0]] for name in ("actor", "epoch", "env")}
    oldest = max(progress.valid_from, serial - FARTHEST)
    while rows["episode_step"][chain[-1]] > 0 and serial > oldest:
        serials = np.arange(serial - 1, max(oldest, serial - CHUNK) - 1, -1)
        slots, serial = serials % ring.capacity, serial - len(serials)
        same = np.logical_and.reduce([ring.holds(serials), *(rows[name][slots] == origin[name] for name in origin)])
        for slot in slots[same].tolist():
            if rows["episode_step"][chain[-1]] == 0:
                break
            if len(chain) == most or not _adjoins(ring, slot, chain[-1]):
                return None
            chain.append(slot)
    return np.array(chain[::-1]) if rows["episode_step"][chain[-1]] == 0 else None


def _adjoins(ring: Ring, earlier: int, later: int) -> bool:
    """Whether no step is missing between the windows in two slots, and what both hold is the same.

    Where an episode's own first windows are gone, those of the one before may end at just that step.
    """
    begins, first, last = (ring.rows[name] for name in ("episode_step", "first", "last"))
    offset, end = int(begins[later]) - int(begins[earlier]), int(last[earlier])
    if not 0 < offset <= end - ring.spec.burn_in:
        return False
    begin = max(int(first[earlier]), int(first[later]) + offset)
    for name, to in (("observation", end + 1), ("action", end)):  # actions differ where all frames are missing
        values = ring.rows[name]
        if not np.array_equal(values[earlier, begin:to], values[later, begin - offset : to - offset]):
            return False
    return True
