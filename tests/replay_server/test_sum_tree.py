"""The sum tree against brute force, its two sets of kernels against each other, and a chi-squared test."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from replay_server.sum_tree import SumTree, compiled_kernels

KERNELS = pytest.mark.parametrize("compiled", [True, False])


def test_numba_is_what_runs_here() -> None:
    assert compiled_kernels() is not None


@KERNELS
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_against_brute_force(compiled: bool, data: st.DataObject) -> None:
    capacity = data.draw(st.integers(1, 40))
    tree, plain = SumTree(capacity, compiled), np.zeros(capacity)
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
def test_kernels_and_rebuild_give_the_same_bits(capacity: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    fast, slow, rebuilt = SumTree(capacity), SumTree(capacity, compiled=False), SumTree(capacity)
    for _ in range(5):
        slots, values = rng.integers(0, capacity, 20), rng.exponential(size=20) * (rng.random(20) < 0.7)
        fast.set(slots, values)
        slow.set(slots, values)
    rebuilt.rebuild(fast.values(np.arange(capacity)))
    assert fast.total == slow.total == rebuilt.total
    if fast.total > 0:
        draws = [tree.sample(64, np.random.default_rng(seed)) for tree in (fast, slow, rebuilt)]
        assert np.array_equal(draws[0], draws[1])
        assert np.array_equal(draws[0], draws[2])
        assert (fast.values(draws[0]) > 0).all()


@KERNELS
def test_the_end_of_the_range_is_never_an_empty_slot(compiled: bool) -> None:
    tree = SumTree(10, compiled)
    tree.set(np.array([2, 5]), np.array([0.1, 0.7]))
    ends = np.array([0.0, np.nextafter(tree.total, 0.0), tree.total, tree.total * 2])
    assert tree.find(ends).tolist() == [2, 5, 5, 5]


@KERNELS
def test_frequencies_are_proportional(compiled: bool) -> None:
    """Chi-squared over independent uniform positions, and tighter still with strata."""
    rng = np.random.default_rng(1)
    values = rng.exponential(size=50)
    values[::7] = 0.0
    tree, batches, batch_size = SumTree(50, compiled), 400, 256
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
