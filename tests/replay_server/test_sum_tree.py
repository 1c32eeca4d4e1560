"""The sum tree against brute force, against one rebuilt from its leaves, and a chi-squared test."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rmc.replay_server.sum_tree import SumTree


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_against_brute_force(data: st.DataObject) -> None:
    capacity = data.draw(st.integers(1, 40))
    tree, plain = SumTree(capacity), np.zeros(capacity)
    values = st.integers(0, 1000).map(float)  # whole numbers: sums are exact, so positions are comparable
    for _ in range(data.draw(st.integers(1, 5))):
        slots = data.draw(hnp.arrays(np.int64, st.integers(0, 12), elements=st.integers(0, capacity - 1)))
        new = data.draw(hnp.arrays(np.float64, len(slots), elements=values))
        tree.set(slots, new)
        for slot, value in zip(slots, new, strict=True):
            plain[slot] = value
    assert np.array_equal(tree.values(np.arange(capacity)), plain)
    assert tree.total == plain.sum()
    positions = np.arange(min(int(plain.sum()), 500)) + 0.5
    assert np.array_equal(tree.find(positions), np.searchsorted(np.cumsum(plain), positions, side="right"))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 70), st.integers(0, 2**32 - 1))
def test_one_rebuilt_has_the_same_bits(capacity: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree, rebuilt = SumTree(capacity), SumTree(capacity)
    for _ in range(5):
        tree.set(rng.integers(0, capacity, 20), rng.exponential(size=20) * (rng.random(20) < 0.7))
    rebuilt.rebuild(tree.values(np.arange(capacity)))
    assert tree.total == rebuilt.total
    if tree.total > 0:
        drawn = tree.sample(64, np.random.default_rng(seed))
        assert np.array_equal(drawn, rebuilt.sample(64, np.random.default_rng(seed)))
        assert (tree.values(drawn) > 0).all()


def test_the_end_of_the_range_is_never_an_empty_slot() -> None:
    tree = SumTree(10)
    tree.set(np.array([2, 5]), np.array([0.1, 0.7]))
    ends = np.array([0.0, np.nextafter(tree.total, 0.0), tree.total, tree.total * 2])
    assert tree.find(ends).tolist() == [2, 5, 5, 5]


def test_frequencies_are_proportional() -> None:
    """Chi-squared over independent uniform positions, and tighter still with strata."""
    rng = np.random.default_rng(1)
    values = rng.exponential(size=50)
    values[::7] = 0.0
    tree, batches, batch_size = SumTree(50), 400, 256
    tree.set(np.arange(50), values)
    expected = values / values.sum() * batches * batch_size
    real = expected > 0
    free = tree.find(rng.random(batches * batch_size) * tree.total)
    strata = np.concatenate([tree.sample(batch_size, rng) for _ in range(batches)])
    degrees = real.sum() - 1
    for slots, limit in ((free, degrees + 5 * np.sqrt(2 * degrees)), (strata, degrees)):
        counts = np.bincount(slots, minlength=50)
        assert (counts[~real] == 0).all()
        assert ((counts - expected)[real] ** 2 / expected[real]).sum() < limit


def test_every_stratum_gives_one() -> None:
    tree = SumTree(64)
    tree.set(np.arange(64), np.ones(64))
    assert np.array_equal(tree.sample(64, np.random.default_rng(3)), np.arange(64))
