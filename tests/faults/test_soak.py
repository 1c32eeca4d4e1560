"""Whether memory grows is told amid its swings, and whether files stay open."""

import random
from types import SimpleNamespace
from typing import Any

import pytest

from tests.faults import soak
from tests.faults.soak import files_growth, memory_growth, watch


@pytest.mark.parametrize("growth", [-0.1, 0.0, 0.05])
def test_growth_amid_swings(growth: float) -> None:
    chance, count = random.Random(3), 800
    looks = [
        {"redis": (5.0 * (1 + growth * look / count) * chance.uniform(0.9, 1.1), 1), "learner": (400.0, 1)}
        for look in range(count)
    ]
    assert memory_growth(looks) == {"redis": pytest.approx(growth, abs=0.015), "learner": 0.0}
    assert memory_growth(looks[:1]) == {"redis": 0.0, "learner": 0.0}


@pytest.mark.parametrize(("leaks", "growth"), [(0, 0), (1, 3)])
def test_files_that_stay_open_are_told(leaks: int, growth: int) -> None:
    """And not those that are open for a moment."""
    looks = [{"learner": (400.0, 20 + leaks * look + (look % 3 == 0))} for look in range(6)]
    assert files_growth(looks) == {"learner": growth}
    with pytest.raises(AssertionError, match="the first looks are the last ones"):
        files_growth(looks[:5])


@pytest.mark.parametrize(
    ("seconds", "looked"),
    [(14.0, [2, 4, 6, 8, 10, 12, 14]), (13.0, [2, 4, 6, 8, 10, 12, 13]), (5, [2, 4, 5, 7, 9, 11])],
)
def test_it_looks_from_the_first_moment_to_the_last(
    seconds: float, looked: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And on until the first looks are not the last ones, too."""
    now = [0.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr(soak, "time", clock)
    run: Any = SimpleNamespace(held=lambda: {"learner": (now[0], 1)})
    looks = watch(run, seconds, 2.0, 2.0)
    assert [look["learner"][0] for look in looks] == looked
