"""The sum tree: sampling in proportion to a value per slot, in O(log capacity).

Nodes lie in one array: node 1 is the root, node i has children 2i and 2i + 1, leaf s is node size + s.
Parents are recomputed from their children, never incremented, so no rounding error builds up and a
tree rebuilt from the same leaves has the same bits.
"""

import numpy as np
from numpy.typing import NDArray

from rmc.common.compiled import compiled
from rmc.common.window import Slots

Values = NDArray[np.float64]


@compiled
def _set(nodes: Values, size: int, slots: Slots, values: Values) -> None:
    for i in range(slots.shape[0]):
        nodes[size + slots[i]] = values[i]
    for i in range(slots.shape[0]):
        node = (size + slots[i]) // 2
        while node >= 1:
            nodes[node] = nodes[2 * node] + nodes[2 * node + 1]
            node //= 2


@compiled
def _find(nodes: Values, size: int, positions: Values, slots: Slots) -> None:
    for i in range(positions.shape[0]):
        node, position = 1, positions[i]
        while node < size:
            node *= 2
            left_mass = nodes[node]
            if position >= left_mass and nodes[node + 1] > 0.0:  # rounding never leads to an empty leaf
                position -= left_mass
                node += 1
        slots[i] = node - size


class SumTree:
    """Non-negative values of ``capacity`` slots; all 0 at first. Not thread-safe."""

    def __init__(self, capacity: int) -> None:
        self.size = 1 << max(capacity - 1, 1).bit_length()
        self._nodes: Values = np.zeros(2 * self.size)
        self.set(np.zeros(1, np.int64), np.zeros(1))  # compiles both now, not amid a run
        _find(self._nodes, self.size, np.zeros(1), np.zeros(1, np.int64))

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self._nodes[1])

    def set(self, slots: Slots, values: Values) -> None:
        """Give (B,) slots new values; of a slot named twice, the last counts."""
        _set(self._nodes, self.size, slots, values)

    def values(self, slots: Slots) -> Values:
        """Values of (B,) slots."""
        return self._nodes[self.size + slots]

    def leaves(self) -> Values:
        """(size,) the values of all slots."""
        return self._nodes[self.size :]

    def rebuild(self, values: Values) -> None:
        """Replace everything by (capacity,) values."""
        self.set(np.arange(len(values)), values)

    def find(self, positions: Values) -> Slots:
        """The slot at which the running sum of values passes each of (B,) positions in [0, total)."""
        slots = np.empty(len(positions), np.int64)
        _find(self._nodes, self.size, positions, slots)
        return slots

    def sample(self, batch_size: int, random: np.random.Generator) -> Slots:
        """(B,) slots in proportion to their values, one from each of B equal strata. The total must not be 0."""
        strata = (np.arange(batch_size) + random.random(batch_size)) / batch_size
        return self.find(strata * self.total)
