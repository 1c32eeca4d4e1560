"""The guard says what is worse than the lines of before, and nothing where that is within chance."""

import dataclasses

import pytest

from benchmarks.guard import Line, gflops, verdict

BEFORE = [Line("cue", seed, "0000000", result, 80.0, 200.0) for seed, result in ((1, 3.0), (2, 4.0), (3, 3.5))]
SAME = Line("cue", 1, "1111111", 3.0, 80.0, 200.0)


@pytest.mark.parametrize(
    ("changed", "judgement"),
    [
        ({}, "ok"),
        ({"episode_return": 2.41}, "ok"),
        ({"episode_return": 2.39}, "return below 80% of 3.0, the least of 3 lines"),
        ({"updates_per_s": 40.0, "gflops": 100.0}, "ok"),  # a machine of half the speed
        ({"updates_per_s": 71.0}, "speed below 90% of 400.0, the median of 3 lines"),
        ({"task": "another"}, "nothing to compare with"),
    ],
)
def test_what_is_worse_is_named(changed: dict[str, object], judgement: str) -> None:
    assert verdict(dataclasses.replace(SAME, **changed), BEFORE) == judgement  # type: ignore[arg-type]


def test_a_machine_multiplies() -> None:
    assert gflops(0.05) > 0.1
