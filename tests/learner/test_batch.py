"""The batch's views against a plain loop over the rows."""

import numpy as np
import pytest
import torch

from rmc.learner.batch import (
    Plan,
    clear_padding,
    has_missing,
    importance_weights,
    longest_steps,
    view_batch,
)
from tests.learner.rows import BY_NUMBER, LONG, SPEC, random_rows, spoil_padding, to_batch


@pytest.mark.parametrize("spec", [SPEC, BY_NUMBER])
def test_fields_match_the_rows(spec):
    rows = random_rows(16, spec=spec)
    batch = to_batch(rows, spec)
    for b, row in enumerate(rows):
        for t in range(SPEC.observations):
            real = row["first"] <= t <= row["last"]
            assert bool(batch.observation_valid[b, t]) == real
            wanted = row["observation"][t] if real else np.zeros(3)
            np.testing.assert_array_equal(batch.observation[b, t], wanted)
            assert batch.missing[b, t].tolist() == [bool(real and flag) for flag in row["missing"][t]]
            np.testing.assert_array_equal(
                batch.privileged[b, t], row["privileged"][t] if real else 0.0 * row["privileged"][t]
            )
        for t in range(SPEC.steps):
            real = row["first"] <= t < row["last"]
            assert bool(batch.step_valid[b, t]) == real
            assert float(batch.reward[b, t]) == (row["reward"][t] if real else 0.0)
            assert bool(batch.terminated[b, t]) == bool(row["terminated"] and t == row["last"] - 1)
        np.testing.assert_array_equal(batch.state[b], row["state"])
        assert bool(batch.burned_in[b]) == (row["first"] == 0)


def test_previous_action_of_the_first_real_step_is_the_stored_one():
    rows = random_rows(16)
    batch = to_batch(rows)
    for b, row in enumerate(rows):
        first, last = int(row["first"]), int(row["last"])
        np.testing.assert_array_equal(batch.prev_action[b, first], row["prev_action"])
        for t in range(first + 1, last + 1):
            np.testing.assert_array_equal(batch.prev_action[b, t], row["action"][t - 1])
        assert not batch.prev_action[b, :first].any()
        assert not batch.prev_action[b, last + 1 :].any()


def test_row_is_a_multiple_of_a_cache_line_and_the_fingerprint_follows_the_sizes():
    from rmc.common.window import WindowSpec

    assert SPEC.dtype.itemsize % 64 == 0
    others = [WindowSpec(4, 2, 8, 4, 5), WindowSpec(3, 2, 8, 3, 6)]
    assert SPEC.fingerprint not in {other.fingerprint for other in others}


def test_importance_weights_against_the_formula():
    values = np.random.default_rng(0).exponential(size=20)
    mass, windows = 3.0 * values.sum(), 60
    expected = np.array([(windows * value / mass) ** -0.4 for value in values])
    weights = importance_weights(values, 0.4)
    np.testing.assert_allclose(weights, expected / expected.max(), rtol=1e-5)
    assert weights.dtype == np.float32
    assert (importance_weights(values, 0.0) == 1).all()


@pytest.mark.parametrize("spec", [SPEC, BY_NUMBER])
def test_padding_is_cleared_and_nothing_else_touched(spec):
    rows = random_rows(16, spec=spec)
    clean = rows.copy()
    spoil_padding(rows)
    clear_padding(rows, spec)
    for name in rows.dtype.names:
        np.testing.assert_array_equal(rows[name], clean[name])


@pytest.mark.parametrize(
    ("trained", "rounded"), [(1, 16), (16, 16), (17, 24), (24, 24), (25, 32), (33, 48), (49, 60), (60, 60)]
)
def test_the_longest_window_rounded_up_says_where_a_batch_ends(trained: int, rounded: int) -> None:
    rows = random_rows(5, spec=LONG, longest=trained)
    raw = torch.from_numpy(rows.view("u1").reshape(len(rows), -1))
    assert longest_steps(raw, LONG) == LONG.burn_in + rounded


def test_windows_of_the_usual_length_are_never_cut() -> None:
    rows = random_rows(5, longest=1)
    assert longest_steps(torch.from_numpy(rows.view("u1").reshape(len(rows), -1)), SPEC) == SPEC.steps


def test_a_cut_batch_is_the_whole_one_without_padding() -> None:
    rows = random_rows(6, spec=LONG, longest=20)
    whole, raw = to_batch(rows, LONG), torch.from_numpy(rows.view("u1").reshape(len(rows), -1))
    steps = longest_steps(raw, LONG)
    cut = view_batch(raw, torch.ones(len(rows)), LONG, Plan(steps, True, True, True))
    assert (cut.cut, whole.cut) == (LONG.steps - steps, 0)
    for name, value in vars(cut).items():
        of_whole = getattr(whole, name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, of_whole[:, : value.shape[1]] if value.ndim > 1 else of_whole), name
    assert not whole.observation_valid[:, steps + 1 :].any()


@pytest.mark.parametrize("window", [None, 0, 4])
def test_one_missing_frame_is_seen(window: int | None) -> None:
    rows = random_rows(5)
    rows["missing"] = 0
    if window is not None:
        rows["missing"][window, rows["first"][window]] = 1
    assert has_missing(torch.from_numpy(rows.view("u1").reshape(5, -1)), SPEC) == (window is not None)
