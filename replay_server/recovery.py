"""Opening a replay folder: lock it, map ring and priorities, believe only what was committed.

Folder: ``ring`` (identity, commit records, rows), ``priorities`` (float32 per slot, raw, before the
exponent), ``lock``. The sum tree is never stored: it is rebuilt from the priorities of the valid windows.
"""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rmc.common.errors import ConfigError
from rmc.common.process.file_lock import take_lock
from rmc.common.window import Slots, WindowSpec
from rmc.replay_server.ring import Ring, reserve
from rmc.replay_server.sum_tree import SumTree, Values

log = logging.getLogger(__name__)


@dataclass
class ReplayStore:
    """What a replay folder holds, locked until ``close``."""

    ring: Ring
    priorities: NDArray[np.float32]  # (capacity,) mapped
    tree: SumTree
    lock: int
    exponent: float

    def leaf_values(self, priorities: NDArray[np.float32]) -> Values:
        """p ** exponent, what the tree holds."""
        return priorities.astype(np.float64) ** self.exponent

    def set_priorities(self, slots: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """New raw priorities of (B,) slots, in the map and the tree."""
        self.priorities[slots] = priorities
        self.tree.set(slots, self.leaf_values(priorities))

    def largest_priority(self, overwritten: Slots) -> float:
        """Of the windows that are there, with which a new one enters; the last known where that cannot be told.

        Those of (B,) slots are there no more, but in the tree still.
        """
        if not self.exponent:  # of no effect
            return self.ring.progress.max_priority
        there = self.tree.leaves() > 0.0
        there[overwritten] = False
        if not there.any():
            return self.ring.progress.max_priority
        return float(self.priorities[there[: len(self.priorities)]].max())

    def forget(self, slots: NDArray[np.int64]) -> None:
        """Let (B,) slots hold no windows: none is drawn from them, now or after a restart."""
        self.ring.forget(slots)
        self.tree.set(slots, np.zeros(len(slots)))

    def flush(self) -> None:
        """Hand everything to the disk."""
        self.ring.flush()
        assert isinstance(self.priorities, np.memmap)
        self.priorities.flush()

    def close(self) -> None:
        """Let another process open the folder."""
        os.close(self.lock)


def open_store(folder: Path, spec: WindowSpec, capacity: int, exponent: float) -> ReplayStore:
    """Create or recover the store in ``folder``.

    Raises ConfigError: held by another process, of other windows or capacity, damaged, or no space.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = _lock(folder)
    try:
        ring = Ring(folder / "ring", spec, capacity)
        priorities = _map_priorities(folder / "priorities", ring)
        store = ReplayStore(ring, priorities, SumTree(capacity), lock, exponent)
        store.tree.rebuild(valid_leaves(store))
    except BaseException:
        os.close(lock)
        raise
    return store


def valid_leaves(store: ReplayStore) -> Values:
    """(capacity,) what the tree's leaves must be: 0 wherever no window may be sampled."""
    ring = store.ring
    leaves = np.zeros(ring.capacity)
    serials = np.arange(ring.progress.valid_from, ring.progress.next_serial)
    slots = serials[ring.holds(serials)] % ring.capacity
    leaves[slots] = store.leaf_values(store.priorities[slots])
    return leaves


def _lock(folder: Path) -> int:
    lock = take_lock(folder / "lock")
    if lock is None:
        raise ConfigError("--run-dir", str(folder), "another replay server holds this folder; stop it first")
    return lock


def warn_of_torn_rows(store: ReplayStore) -> None:
    """A committed row without its serial was lost to a power cut, or found damaged when it was drawn."""
    torn = store.ring.progress.windows - int(np.count_nonzero(store.tree.leaves()))
    if torn:
        log.warning("replay ring: %d windows were damaged or torn by a crash; they are never drawn", torn)


def _map_priorities(path: Path, ring: Ring) -> NDArray[np.float32]:
    size = 4 * ring.capacity
    if not (path.exists() and path.stat().st_size == size):
        reserve(path, size, ring.capacity)
    priorities: NDArray[np.float32] = np.memmap(path, np.float32, "r+", shape=(ring.capacity,))
    # Zeros of a new file, or where a power cut kept them from the disk, and what is larger than any that was seen.
    unusable = ~((priorities > 0) & (priorities <= np.float32(ring.progress.max_priority)))
    priorities[unusable] = ring.progress.max_priority
    return priorities
