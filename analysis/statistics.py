"""Few runs told honestly: interquartile means, bootstrap intervals, the probability that one agent beats another.

As Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021), define them.
Shapes: R runs (seeds).
"""

import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.float64]
RESAMPLES = 2_000
LEVEL = 0.95  # of an interval
ENOUGH_SEEDS = 5  # for an interval: below, a bootstrap knows too little


def interquartile_mean(scores: Scores) -> float:
    """Mean without the lowest and the highest quarter, each rounded down to whole scores."""
    ordered = np.sort(scores, axis=None)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def interval(scores: Scores, resamples: int = RESAMPLES) -> tuple[float, float]:
    """Percentile bootstrap of the interquartile mean of (R,) scores."""
    random, runs = np.random.default_rng(0), len(scores)
    estimates = [interquartile_mean(scores[random.integers(0, runs, runs)]) for _ in range(resamples)]
    low, high = np.quantile(estimates, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """P(a run of the first scores above one of the second), ties a half: (R,), (R',)."""
    above = np.sign(scores[:, None] - others[None, :])
    return float((0.5 + 0.5 * above).mean())
