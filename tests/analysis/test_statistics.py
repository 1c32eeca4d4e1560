"""Statistics of few runs, against values known otherwise."""

import numpy as np
import pytest
from scipy import stats

from rmc.analysis.statistics import interquartile_mean, interval, probability_of_improvement


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8, 30])
def test_the_interquartile_mean_is_a_trimmed_mean(count):
    scores = np.random.default_rng(count).normal(size=count)
    assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25))


def test_an_outlier_does_not_move_it():
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, 4.0])) == 2.5
    assert interquartile_mean(np.array([-1e9, 2.0, 3.0, 1e9])) == 2.5


def test_a_probability_of_improvement_is_mann_whitneys_u():
    random = np.random.default_rng(0)
    ours, theirs = random.normal(0.5, 1.0, 7), random.normal(0.0, 1.0, 5)
    u = stats.mannwhitneyu(ours, theirs).statistic
    assert probability_of_improvement(ours, theirs) == pytest.approx(u / 35)
    assert probability_of_improvement(ours, ours) == 0.5
    assert probability_of_improvement(ours + 100, ours) == 1.0


def test_an_interval_holds_the_truth_about_as_often_as_it_says():
    """Of a normal, 20 runs: the percentile bootstrap is a little narrow."""
    random = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        low, high = interval(random.normal(size=20), resamples=300)
        held += low <= 0.0 <= high
    assert 0.86 < held / 200 < 0.99


def test_an_interval_is_scipys_bootstrap():
    scores = np.random.default_rng(2).normal(size=100)
    low, high = interval(scores)
    data, trimmed = (scores,), lambda x, axis: stats.trim_mean(x, 0.25, axis)
    theirs = stats.bootstrap(data, trimmed, method="percentile", n_resamples=9999, rng=3).confidence_interval
    assert (low, high) == pytest.approx(theirs, abs=0.02)
