"""The number of threads is tried under load, and the fastest kept with the run."""

import itertools

import pytest

from rmc.learner.thread_trial import ROUNDS, TURN, ThreadTrial


def tried(took: dict[int, float]) -> tuple[ThreadTrial, list[int], list[int]]:
    """A trial to its end; the numbers set, and that of each update."""
    used: list[int] = []
    trial, updates = ThreadTrial(tuple(took), used.append), []
    while not trial.chosen:
        updates.append(used[-1])
        trial.note(took[used[-1]] * (50.0 if (len(updates) - 1) % TURN < 4 else 1.0))  # slow after each change
    return trial, used, updates


@pytest.mark.parametrize("fastest", [1, 2, 4])
def test_the_fastest_is_kept(fastest: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    took = {number: 0.005 if number == fastest else 0.007 for number in (1, 2, 4)}
    trial, used, updates = tried(took)
    assert trial.chosen == used[-1] == fastest
    assert [number for number, _ in itertools.groupby(updates)] == [1, 2, 4] * ROUNDS
    assert len(updates) == 3 * ROUNDS * TURN
    assert f"threads of an update: {fastest} (" in caplog.text
    assert f"5.0 ms with {fastest}" in caplog.text


def test_updates_of_two_kinds_do_not_mislead_it() -> None:
    """The policy trains at every second update. One late one in a turn moves a median of all to the other kind."""
    used: list[int] = []
    trial, updates = ThreadTrial((1, 2), used.append), 0
    while not trial.chosen:
        is_long = updates % 2 == 0 or (used[-1] == 2 and updates % TURN == 51)
        trial.note((0.010 if is_long else 0.006) * (0.9 if used[-1] == 2 else 1.0))
        updates += 1
    assert trial.chosen == 2


def test_what_an_earlier_start_chose_is_taken_up_untried() -> None:
    used: list[int] = []
    trial = ThreadTrial((1, 2), used.append)
    trial.take_up(8)  # of a larger machine
    assert (trial.chosen, used) == (0, [1])
    trial.take_up(2)
    trial.note(1.0)
    assert (trial.chosen, used) == (2, [1, 2])


def test_nothing_is_tried_where_there_is_no_choice() -> None:
    used: list[int] = []
    one, none = ThreadTrial((3,), used.append), ThreadTrial((), used.append)
    none.note(1.0)
    assert (one.chosen, none.chosen, used) == (3, 0, [3])


def test_what_was_not_tried_is_not_kept() -> None:
    """A run that comes home from one core of a cluster tries what this machine has."""
    away, home = ThreadTrial((1,), lambda _: None), ThreadTrial((1, 2, 4), lambda _: None)
    home.take_up(away.found)
    assert (away.chosen, away.found, home.chosen) == (1, 0, 0)
    home.take_up(2)
    assert home.found == 2
