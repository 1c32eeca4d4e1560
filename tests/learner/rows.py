"""Random but lawful rows for the learner's tests."""

import dataclasses

import numpy as np
import torch

from rmc.common.window import Rows, WindowSpec
from rmc.learner.batch import Batch, clear_padding, view_batch

SPEC = WindowSpec(obs_dim=3, action_dim=2, state=8, burn_in=4, train=5)
LONG = WindowSpec(obs_dim=3, action_dim=2, state=8, burn_in=4, train=60)
BY_NUMBER = dataclasses.replace(SPEC, missing=3, privileged=2)  # what is missing comes by number; critics see more


def observation_valid(rows: Rows, spec: WindowSpec = SPEC) -> np.ndarray:
    """(B, T + 1): which observations are real."""
    t = np.arange(spec.observations)
    return (rows["first"][:, None] <= t) & (t <= rows["last"][:, None])


def step_valid(rows: Rows, spec: WindowSpec = SPEC) -> np.ndarray:
    """(B, T): which steps are real; the last observation starts none."""
    t = np.arange(spec.steps)
    return (rows["first"][:, None] <= t) & (t < rows["last"][:, None])


def spoil_padding(rows: Rows) -> None:
    """Write what no number is wherever a row holds nothing."""
    observed, stepped = observation_valid(rows), step_valid(rows)
    rows["observation"][~observed] = np.nan
    rows["privileged"][~observed] = np.nan
    rows["missing"][~observed] = 1
    rows["action"][~stepped] = np.inf
    rows["reward"][~stepped] = np.nan


def random_rows(count: int, seed: int = 0, spec: WindowSpec = SPEC, longest: int | None = None) -> Rows:
    """Rows of every shape: padded and real burn-in, full and partial, terminated and not.

    Each trains ``longest`` steps at most, and where that is said the first one does.
    """
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, spec.dtype)
    rows["serial"] = np.arange(count)
    rows["first"] = rng.choice([0, spec.burn_in], count)
    rows["episode_step"] = spec.burn_in
    rows["last"] = rng.integers(spec.burn_in + 1, spec.burn_in + (longest or spec.train) + 1, count)
    if longest is not None:
        rows["last"][0] = spec.burn_in + longest
    rows["terminated"] = rng.integers(0, 2, count)
    rows["missing"] = rng.uniform(size=rows["missing"].shape) < 0.3
    for name in ("observation", "action", "prev_action", "reward", "state", "privileged"):
        rows[name] = rng.uniform(-1.0, 1.0, rows[name].shape)
    observed, stepped = observation_valid(rows, spec), step_valid(rows, spec)
    rows["observation"] *= observed[..., None]
    rows["privileged"] *= observed[..., None]
    rows["missing"] *= observed[..., None]
    rows["action"] *= stepped[..., None]
    rows["reward"] *= stepped
    return rows


def to_batch(rows: Rows, spec: WindowSpec = SPEC, importance: np.ndarray | None = None) -> Batch:
    """Rows as the learner sees them."""
    weights = np.ones(len(rows), np.float32) if importance is None else importance
    clear_padding(rows, spec)
    return view_batch(torch.from_numpy(rows.view("u1").reshape(len(rows), -1)), torch.from_numpy(weights), spec)
