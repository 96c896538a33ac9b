"""When a training ends before its time: a column of metrics.csv passes a threshold."""

import math
from collections.abc import Mapping
from typing import Annotated, Any

from train.tables import read_number, table_option

COLUMNS = (
    *("reward", "episode_return", "completeness", "covariance_norm_mean", "covariance_norm_sum"),
    *("live_tracks", "mean_scan_value", "policy_loss", "value_loss", "entropy", "approximate_kl"),
    *("clip_fraction", "steps_taken", "gradient_norm", "explained_variance"),
)
"""Columns that every training has and that can end one; `info_metrics` of the environment are more."""

Thresholds = Annotated[dict[str, float], table_option("COLUMN=NUMBER", "completeness=0.9", read_number, str)]
"""Columns of metrics.csv to their thresholds."""


def check_thresholds(table: str, thresholds: Mapping[str, Any], info_metrics: tuple[str, ...]) -> None:
    """Refuses thresholds of columns that there are not, and those that are no numbers.

    Raises:
        ValueError: one line that names the table and the column.
    """
    known = (*COLUMNS, *info_metrics)
    for name, threshold in thresholds.items():
        if name not in known:
            raise ValueError(
                f"{table}.{name}: expected one of {', '.join(known)}; more metrics by static.info_metrics"
            )
        is_number = isinstance(threshold, (int, float)) and not isinstance(threshold, bool)
        if not is_number or not math.isfinite(threshold):
            raise ValueError(f"{table}.{name} = {threshold!r}: expected a number")


def passed(row: Mapping[str, str], above: Mapping[str, float], below: Mapping[str, float]) -> str:
    """The first threshold that a row of metrics.csv passes, in words; empty if it passes none.

    An empty cell passes none.
    """
    sides = ((above, "above", 1), (below, "below", -1))
    for thresholds, word, sign in sides:
        for name, threshold in thresholds.items():
            if row[name] and sign * float(row[name]) > sign * threshold:
                return f"{name} = {row[name]} is {word} {threshold:g}"
    return ""
