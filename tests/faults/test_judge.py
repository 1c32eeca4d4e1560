"""The judge sees what is missing."""

import numpy as np
import pytest

from rmc.common.window import Rows
from tests.faults.judge import _doubled, _lost, _older
from tests.replay_server.support import SPEC, make_rows


def life() -> Rows:
    """Three entries of four windows, each of one environment's next four steps."""
    rows = make_rows(12)
    rows["seq"], rows["k"] = np.repeat([1, 2, 3], 4), np.tile(range(4), 3)
    rows["episode_step"] = np.arange(12) * SPEC.train
    return rows


@pytest.mark.parametrize(("full", "acked"), [(False, 3), (True, 3), (True, 2)])
def test_nothing_is_missing(full: bool, acked: int) -> None:
    assert _lost(life(), acked, full) == 0
    assert _lost(life()[2:], acked, full=True) == 0  # age takes from the front


@pytest.mark.parametrize("gone", [slice(4, 8), slice(5, 6), slice(7, 8), slice(4, 5)])
def test_an_entry_or_a_window_that_is_missing_is_seen(gone: slice) -> None:
    assert _lost(np.delete(life(), gone), 3, full=True) > 0


def test_what_was_acknowledged_and_never_came_is_seen() -> None:
    assert _lost(life(), 4, full=True) == 1
    assert _lost(life()[:0], 4, full=False) == 4
    assert _lost(life()[1:], 3, full=False) > 0


def test_windows_of_older_weights_are_seen() -> None:
    own = life()
    own["weights_update"] = np.arange(12) // 3
    assert _older(own) == 0
    own["weights_update"][7] = 0
    assert _older(own) == 1
    own["env"] = np.arange(12) % 2
    own["weights_update"] = own["env"]  # another environment's are not before
    assert _older(own) == 0


def test_a_window_that_is_there_twice_is_seen() -> None:
    assert _doubled(life()) == 0
    assert _doubled(np.concatenate([life(), life()[3:5]])) == 2
