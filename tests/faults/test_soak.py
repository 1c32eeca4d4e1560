"""Whether memory grows is told amid its swings."""

import random

import pytest

from tests.faults.soak import memory_growth


@pytest.mark.parametrize("growth", [-0.1, 0.0, 0.05])
def test_growth_amid_swings(growth: float) -> None:
    chance, count = random.Random(3), 800
    looks = [
        {"redis": (5.0 * (1 + growth * look / count) * chance.uniform(0.9, 1.1), 1), "learner": (400.0, 1)}
        for look in range(count)
    ]
    assert memory_growth(looks) == {"redis": pytest.approx(growth, abs=0.015), "learner": 0.0}
    assert memory_growth(looks[:1]) == {"redis": 0.0, "learner": 0.0}
