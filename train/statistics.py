"""Intervals of means, differences and probabilities over scenarios that all policies met.

A value is known per training seed and scenario, `[S, E]`. The scenarios are the sample: they are
resampled with replacement, the same ones in every stratum, because all training seeds and all
policies were played on the same scenarios. Training seeds are strata: none is left out, so an
interval speaks of these trainings and not of further ones. Intervals are percentiles of the
resamples (95 %). NaN, where a scenario does not define a metric, is left out.
"""

from typing import NamedTuple

import numpy as np

RESAMPLES = 2000
PERCENTILES = (2.5, 97.5)
TRIMMED = 4
"""The interquartile mean drops a 4th of the values at either end (`scipy.stats.trim_mean`)."""


class Estimate(NamedTuple):
    """A value and the two ends of its 95 % interval."""

    value: float
    low: float
    high: float


def resample(episodes: int, resamples: int = RESAMPLES, seed: int = 0) -> np.ndarray:
    """`[1 + B, E]` how often every scenario is drawn; the first row is the sample itself, once each."""
    drawn = np.random.default_rng(seed).multinomial(episodes, np.full(episodes, 1 / episodes), resamples)
    return np.concatenate([np.ones((1, episodes)), drawn])


def mean(values: np.ndarray, drawn: np.ndarray) -> Estimate:
    """Mean of values `[S, E]`.

    Args:
        values: NaN is left out; without any number the result is NaN.
        drawn: of `resample`, here and below.
    """
    known = np.isfinite(values)
    number = drawn @ known.sum(axis=0)
    return _estimate(drawn @ np.where(known, values, 0.0).sum(axis=0), number)


def interquartile_mean(values: np.ndarray, drawn: np.ndarray) -> Estimate:
    """Mean of the middle half of values `[S, E]`, all training seeds together."""
    known = np.isfinite(values)
    scenario = np.broadcast_to(np.arange(values.shape[1]), values.shape)[known]
    order = np.argsort(values[known])
    number = drawn[:, scenario[order]]  # [1 + B, values], in rising order
    last = np.cumsum(number, axis=1)
    total = last[:, -1:] if order.size else np.zeros((len(drawn), 1))
    cut = total // TRIMMED
    kept = np.maximum(np.minimum(last, total - cut) - np.maximum(last - number, cut), 0.0)
    return _estimate(kept @ values[known][order], (total - 2 * cut)[:, 0])


def difference(a: np.ndarray, b: np.ndarray, drawn: np.ndarray) -> Estimate:
    """Mean of a minus b, scenario by scenario; `[S, E]` and `[R, E]`, means over the training seeds."""
    return mean((_seed_mean(a) - _seed_mean(b))[None], drawn)


def probability_of_improvement(a: np.ndarray, b: np.ndarray, less: bool, drawn: np.ndarray) -> Estimate:
    """Probability that a beats b on a scenario; `[S, E]` and `[R, E]`, every seed with every seed.

    Args:
        a: values of the one; equal values count half.
        b: values of the other.
        less: whether less is better.
        drawn: of `resample`.
    """
    first, second = (b, a) if less else (a, b)
    ahead = first[:, None] - second[None]
    score = np.where(np.isnan(ahead), np.nan, (np.sign(ahead) + 1) / 2)
    return mean(score.reshape(-1, score.shape[-1]), drawn)


def seed_means(values: np.ndarray) -> list[float]:
    """Mean over scenarios for each training seed of values `[S, E]`; NaN where none has a value."""
    return [float(entry) for entry in _seed_mean(values.T)]


def _seed_mean(values: np.ndarray) -> np.ndarray:
    """Mean `[E]` over training seeds; NaN where none has a value."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0)


def _estimate(totals: np.ndarray, numbers: np.ndarray) -> Estimate:
    """Quotients of the sample (first) and of its resamples, those without a value left out."""
    with np.errstate(invalid="ignore"):
        quotients = totals / numbers
    again = quotients[1:][np.isfinite(quotients[1:])]
    if not again.size:
        return Estimate(float(quotients[0]), np.nan, np.nan)
    return Estimate(float(quotients[0]), *map(float, np.percentile(again, PERCENTILES)))
