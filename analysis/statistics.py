"""Few runs told honestly: interquartile means, bootstrap intervals, the probability that one agent beats another.

As Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021), define them.
Shapes: R runs (seeds), E environments; a score matrix is (R, E).
"""

from collections.abc import Callable

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


def interval(statistic: Callable[[Scores], float], scores: Scores, resamples: int = RESAMPLES) -> tuple[float, float]:
    """Percentile bootstrap of a statistic of (R, E) scores, runs drawn anew within each environment."""
    random = np.random.default_rng(0)
    estimates = [statistic(_resampled(scores, random)) for _ in range(resamples)]
    low, high = np.quantile(estimates, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def _resampled(scores: Scores, random: np.random.Generator) -> Scores:
    drawn = random.integers(0, scores.shape[0], scores.shape)
    return np.take_along_axis(scores, drawn, axis=0)


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """P(a run of the first scores above one of the second), ties a half, mean over environments: (R, E), (R', E)."""
    above = np.sign(scores[:, None] - others[None, :])
    return float((0.5 + 0.5 * above).mean())
