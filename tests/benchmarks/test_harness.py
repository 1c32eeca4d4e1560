"""What a figure is made of: turns, medians, ratios the right way round, and a goal that is reached twice in a row."""

import math
from collections.abc import Iterator

from benchmarks.end_to_end import PEER, reached, row
from benchmarks.harness import Measure, compare
from benchmarks.report import line


def turns(values: list[float], order: list[str], who: str) -> Measure:
    left: Iterator[float] = iter(values)

    def measure() -> float:
        order.append(who)
        return next(left)

    return measure


def test_ours_peers_and_ceiling_take_turns_and_ratios_are_of_the_same_round() -> None:
    order: list[str] = []
    ours, peer = turns([10.0, 20.0, 90.0], order, "ours"), turns([5.0, 5.0, 30.0], order, "peer")
    limit = "wire", turns([100.0, 100.0, 100.0], order, "limit")
    first, missing = compare("x", "things/s", ours, {"peer": peer, "absent": None}, limit, rounds=3)
    assert order == ["ours", "peer", "limit"] * 3
    assert (first.ours, first.peer_value, first.ratio, first.limit) == (20.0, 5.0, 3.0, 100.0)
    assert first.spread == {"ours": (10.0, 90.0), "peer": (5.0, 30.0), "limit": (100.0, 100.0)}
    assert (missing.peer_value, missing.ratio) == (None, None)
    assert "absent: not installed" in line([{**vars(missing), "day": "today"}])


def test_half_the_time_is_twice_as_good() -> None:
    order: list[str] = []
    ours, peer = turns([10.0], order, "ours"), turns([20.0], order, "peer")
    (row,) = compare("x", "ms", ours, {"peer": peer}, rounds=1, less_is_better=True)
    assert row.ratio == 2.0
    assert "| 10 ms | peer 20, **2.00** |  | today |" in line([{**vars(row), "day": "today"}])


def test_a_goal_is_reached_at_the_second_of_two_evaluations_above_it() -> None:
    points = [(1.0, 0.0), (2.0, 9.0), (3.0, 1.0), (4.0, 9.0), (5.0, 8.0)]
    assert reached(points, 7.0) == 5.0
    assert reached(points, 8.5) is None


def test_a_goal_that_most_seeds_miss_has_no_ratio() -> None:
    times = {"ours": [10.0, 20.0, 30.0], PEER: [40.0, math.inf, math.inf]}
    one = row("Env-v0", 7.0, times, 3)
    assert one is not None
    assert (one.ours, one.peer_value, one.ratio) == (20.0, None, None)
    assert f"{PEER}: not reached" in line([{**vars(one), "day": "today"}])
    assert row("Env-v0", 7.0, {"ours": [10.0, math.inf, math.inf]}, 3) is None
