"""The guard says what is worse than the lines of before, and nothing where that is within chance."""

import dataclasses

import pytest

from benchmarks.guard import Line, faults

BEFORE = [Line("cue", seed, "0000000", result, 80.0, 200.0) for seed, result in ((1, 3.0), (2, 4.0), (3, 3.5))]
SAME = Line("cue", 1, "1111111", 3.0, 80.0, 200.0)


@pytest.mark.parametrize(
    ("changed", "worse"),
    [
        ({}, []),
        ({"episode_return": 2.41}, []),
        ({"episode_return": 2.39}, ["return below 2.4; the least of 3 lines is 3.0"]),
        ({"episode_return": float("nan")}, ["return below 2.4; the least of 3 lines is 3.0"]),
        ({"updates_per_s": 68.0, "gflops": 170.0}, []),  # a slow hour
        *(  # another machine
            ({"gflops": gflops}, [f"no line is of a machine of about {gflops:.0f} GFLOP/s; --record makes a first one"])
            for gflops in (100.0, 400.0)
        ),
        ({"updates_per_s": 71.0}, ["speed below 90% of 400.0, the median of 3 lines"]),
        ({"task": "another"}, ["nothing to compare with; --record makes a first line"]),
    ],
)
def test_what_is_worse_is_named(changed: dict[str, object], worse: list[str]) -> None:
    assert faults(dataclasses.replace(SAME, **changed), BEFORE) == worse  # type: ignore[arg-type]


def test_a_return_below_zero_has_room_as_well() -> None:
    before = [dataclasses.replace(one, episode_return=-100.0) for one in BEFORE]
    assert not faults(dataclasses.replace(SAME, episode_return=-119.0), before)
    assert faults(dataclasses.replace(SAME, episode_return=-121.0), before)
