"""Estimates by hand, and how often their intervals hold what they should."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from train import statistics
from train.statistics import difference, interquartile_mean, mean, probability_of_improvement, resample

FOUR = np.array([[1.0, 2.0, 3.0, 6.0]])
TIMES = 1000


def test_the_first_row_is_the_sample_and_the_others_draw_as_many_scenarios():
    drawn = resample(7)
    assert drawn.shape == (1 + statistics.RESAMPLES, 7)
    np.testing.assert_array_equal(drawn[0], np.ones(7))
    np.testing.assert_array_equal(drawn.sum(axis=1), 7)
    assert drawn[1:].min() == 0
    assert drawn[1:].max() > 2
    np.testing.assert_array_equal(drawn, resample(7))


def test_estimates_are_those_of_the_resamples_one_by_one():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 11))
    drawn = resample(11, resamples=200)
    again = [np.repeat(values, row.astype(int), axis=1) for row in drawn[1:]]
    for estimate, statistic in (
        (mean(values, drawn), np.mean),
        (interquartile_mean(values, drawn), lambda sample: trim_mean(sample, 0.25, axis=None)),
    ):
        assert estimate.value == pytest.approx(statistic(values))
        ends = np.percentile([statistic(sample) for sample in again], (2.5, 97.5))
        np.testing.assert_allclose((estimate.low, estimate.high), ends)


def test_by_hand():
    drawn = resample(4)
    assert mean(FOUR, drawn).value == 3.0
    assert interquartile_mean(FOUR, drawn).value == 2.5
    assert statistics.seed_means(np.array([[1.0, 3.0], [np.nan, 5.0], [np.nan, np.nan]])) == pytest.approx(
        [2.0, 5.0, np.nan], nan_ok=True
    )
    # 3 against 2: better; 2 against 2: as good; 5 against 6 and 1 against 4: worse.
    a, b = np.array([[3.0, 2.0, 5.0, 1.0]]), np.array([[2.0, 2.0, 6.0, 4.0]])
    assert probability_of_improvement(a, b, False, drawn).value == 1.5 / 4
    assert probability_of_improvement(a, b, True, drawn).value == 2.5 / 4
    # Two seeds of the one against one of the other: every seed with every seed.
    assert probability_of_improvement(np.concatenate([a, b]), b, False, drawn).value == 3.5 / 8


def test_differences_are_taken_scenario_by_scenario():
    drawn = resample(4)
    # All four differ by the same: no uncertainty, although the values themselves spread.
    assert difference(FOUR, FOUR + 1, drawn) == (-1.0, -1.0, -1.0)
    value, low, high = difference(FOUR, np.array([[6.0, 3.0, 2.0, 1.0]]), drawn)
    assert value == 0.0
    assert low < -2
    assert high > 2
    # Two training seeds are one policy: their mean counts.
    assert difference(np.concatenate([FOUR, FOUR + 2]), FOUR + 1, drawn) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("statistic", [mean, interquartile_mean])
def test_what_a_scenario_does_not_define_is_left_out(statistic):
    drawn = resample(6)
    holed = np.array([[1.0, np.nan, 2.0, 3.0, np.nan, 6.0]])
    assert statistic(holed, drawn).value == statistic(FOUR, resample(4)).value
    assert all(np.isfinite(statistic(holed, drawn)))
    assert np.isnan(statistic(np.full((1, 6), np.nan), drawn)).all()
    assert statistic(np.array([[7.0]]), resample(1)) == (7.0, 7.0, 7.0)


def test_a_difference_and_a_probability_need_both_values():
    drawn = resample(3)
    a, b = np.array([[1.0, np.nan, 4.0]]), np.array([[2.0, 5.0, np.nan]])
    assert difference(a, b, drawn).value == -1.0
    assert probability_of_improvement(a, b, True, drawn).value == 1.0


def covered(estimates, expected):
    """Share of the intervals that hold the expected value."""
    return np.mean([low <= expected <= high for _, low, high in estimates])


def test_intervals_hold_the_true_value_about_95_times_in_100():
    rng = np.random.default_rng(1)
    drawn = resample(50, resamples=400)
    estimates = {"mean": [], "interquartile mean": [], "difference": [], "probability": []}
    for _ in range(TIMES):
        # Scenarios are easy or hard for every seed and every policy alike.
        scenario = rng.normal(0, 3, 50)
        a, b = (scenario + rng.normal(0, 1, (seeds, 50)) for seeds in (3, 1))
        estimates["mean"].append(mean(a, drawn))
        estimates["interquartile mean"].append(interquartile_mean(a, drawn))
        estimates["difference"].append(difference(a, b + 1, drawn))
        estimates["probability"].append(probability_of_improvement(a, b, True, drawn))
    expected = {"mean": 0.0, "interquartile mean": 0.0, "difference": -1.0, "probability": 0.5}
    for name, value in expected.items():
        # Percentiles of 50 values are a little narrow; three standard errors are 0.02.
        assert 0.91 < covered(estimates[name], value) < 0.97, name
    # The pairs tell apart what the values alone do not.
    wide = np.mean([high - low for _, low, high in estimates["mean"]])
    assert np.mean([high - low for _, low, high in estimates["difference"]]) < wide / 2
