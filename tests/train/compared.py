"""Made-up comparisons, of which every number is known."""

import numpy as np

from train.episode_metrics import CURVES, METRICS
from train.episodes import Comparison, Curve, Played

STEPS = 20


def played(values, seeds=(), **of_metric):
    """A policy whose metrics are all `values` `[S, E]`, but for those named."""
    rows = {metric: np.atleast_2d(np.array(of_metric.get(metric, values), dtype=float)) for metric in METRICS}
    level = float(np.nanmean(rows["gospa"]))
    rising = level + np.arange(STEPS, dtype=float)
    curves = {name: Curve(rising + 0, rising - 1, rising + 1) for name in CURVES}
    looks = np.zeros((3, 3))
    looks[2, 0], looks[1, 1] = 0.75, 0.25  # most to the right and low
    return Played(seeds, rows, curves, looks)


def comparison(**policies):
    """A comparison that took 2 s to compile and 4 s to play."""
    return Comparison(policies, 2.0, 4.0)


# Own GOSPA against two others: 1 lower on every scenario, and better or worse by chance.
THREE = comparison(
    own=played([[1.0, 2.0, 3.0, 6.0], [3.0, 4.0, 5.0, 8.0]], seeds=(0, 7)),
    random=played([3.0, 4.0, 5.0, 8.0]),
    static=played([6.0, 3.0, 2.0, 1.0], nees=[np.nan, np.nan, np.nan, np.nan]),
)
