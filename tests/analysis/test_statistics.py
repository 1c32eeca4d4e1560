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
    ours, theirs = random.normal(0.5, 1.0, (7, 1)), random.normal(0.0, 1.0, (5, 1))
    u = stats.mannwhitneyu(ours[:, 0], theirs[:, 0]).statistic
    assert probability_of_improvement(ours, theirs) == pytest.approx(u / 35)
    assert probability_of_improvement(ours, ours) == 0.5
    assert probability_of_improvement(ours + 100, ours) == 1.0


def test_it_is_the_mean_over_environments():
    ours, theirs = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])
    assert probability_of_improvement(ours, theirs) == (1.0 + 0.25) / 2


def test_an_interval_holds_the_truth_about_as_often_as_it_says():
    """The mean of a normal, 20 runs: the percentile bootstrap is a little narrow."""
    random = np.random.default_rng(1)
    held = 0
    for _ in range(200):
        low, high = interval(lambda x: float(x.mean()), random.normal(size=(20, 1)), resamples=300)
        held += low <= 0.0 <= high
    assert 0.86 < held / 200 < 0.99


def test_environments_are_resampled_each_for_itself():
    """A run of one never stands in for one of another, and two are not drawn alike."""
    scores = np.tile([1.0, 1000.0], (6, 1))
    assert interval(lambda x: float(x[:, 0].mean() - x[:, 1].mean()), scores, resamples=50) == (-999.0, -999.0)
    alike = np.tile(np.arange(6.0)[:, None], 2)
    low, high = interval(lambda x: float(x[:, 0].mean() - x[:, 1].mean()), alike, resamples=200)
    assert low < -0.5 < 0.5 < high


def test_an_interval_holds_19_of_20_estimates():
    """Of a normal's mean: 1.96 standard errors to either side."""
    scores = np.random.default_rng(2).normal(size=(100, 1))
    low, high = interval(lambda x: float(x.mean()), scores)
    assert (high - low) / 2 == pytest.approx(1.96 * scores.std() / 10, rel=0.07)
