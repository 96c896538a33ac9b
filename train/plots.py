"""Figures of training and evaluation. matplotlib is imported on first use."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
COLOUR = "#0b3c8c"

CURVES = {
    "episode_return": "return of an episode",
    "completeness": "completeness (truths tracked)",
    "covariance_norm_mean": "mean covariance norm (m\u00b2)",
}
"""Columns of the metrics file that a learning curve shows, with their labels."""

Interval = tuple[float, float, float]
"""Mean and the low and high end of its interval."""


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Columns of a metrics file by name; an empty or unreadable cell is NaN.

    Raises:
        ValueError: if the file has no row.
    """
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path}: no row of metrics yet")
    return {name: np.array([_number(row[name]) for row in rows]) for name in rows[0]}


def learning_curve(metrics_csv_path: str | Path, out_png: str | Path) -> None:
    """Draws return, completeness and covariance norm against environment steps.

    Args:
        metrics_csv_path: file with a column `env_steps` and those of `CURVES`; missing columns are left out.
        out_png: picture to write.

    Raises:
        ValueError: if a row or the column `env_steps` is missing, or all curves are.
    """
    columns = read_metrics(metrics_csv_path)
    shown = [name for name in CURVES if name in columns]
    if "env_steps" not in columns or not shown:
        expected = ", ".join(["env_steps", *CURVES])
        raise ValueError(f"{metrics_csv_path}: columns {', '.join(columns)}; expected {expected}")
    figure, places = panels(len(shown), height=2.9)
    for axes, name in zip(places, shown, strict=True):
        drawn = np.isfinite(columns["env_steps"]) & np.isfinite(columns[name])
        steps, values = columns["env_steps"][drawn] / 1e6, columns[name][drawn]
        axes.plot(steps, values, color=COLOUR, lw=1.5, marker="." if len(steps) < 2 else None)
        axes.set_title(CURVES[name], fontsize=9.5)
        axes.set_xlabel("environment steps (millions)", fontsize=9)
        axes.grid(color="0.92")
    if "completeness" in shown:
        places[shown.index("completeness")].set_ylim(0, 1.02)
    figure.savefig(out_png)


def comparison(
    table: Mapping[str, Mapping[str, Interval]], titles: Mapping[str, str], out_png: str | Path
) -> None:
    """Draws a dot and an interval per policy for every metric of `titles`.

    Args:
        table: policy, then metric, then (mean, low, high); policies are drawn from top to bottom.
        titles: of the panels, by metric; what the table lacks altogether is left out.
        out_png: picture to write.

    Raises:
        ValueError: if there is no policy, or a policy lacks a metric that another one has.
    """
    given = {name for metrics in table.values() for name in metrics}
    shown = [name for name in titles if name in given]
    if not shown:
        raise ValueError(f"table has nothing to draw: expected a policy with {', '.join(titles)}")
    for policy, metrics in table.items():
        missing = [name for name in shown if name not in metrics]
        if missing:
            raise ValueError(f"table[{policy!r}] lacks {', '.join(missing)}")
    figure, places = panels(len(shown), height=1.1 + 0.28 * len(table))
    for axes, name in zip(places, shown, strict=True):
        _dots_and_intervals(axes, [metrics[name] for metrics in table.values()])
        axes.set_title(titles[name], fontsize=9.5)
        axes.set_yticks(range(len(table)), list(table) if axes is places[0] else [])
        axes.set_ylim(len(table) - 0.5, -0.5)
    figure.savefig(out_png)


def _dots_and_intervals(axes: "Axes", intervals: list[Interval]) -> None:
    mean, low, high = np.array(intervals, dtype=float).T
    rows = np.arange(len(mean))
    axes.hlines(rows, low, high, color=COLOUR, lw=1.2)
    # Bars at the ends keep an interval visible that is narrower than its dot; none is cut at zero.
    axes.plot(mean, rows, "o", color=COLOUR, ms=3.5, clip_on=False)
    axes.plot([low, high], [rows, rows], "|", color=COLOUR, ms=9, clip_on=False)
    axes.grid(axis="y", color="0.92")
    # From zero, so that lengths can be compared.
    axes.set_xlim(0, 1.06 * max(np.nanmax(high), np.finfo(float).tiny))


def panels(
    number: int, height: float, columns: int | None = None, width: float = 2.8
) -> tuple["Figure", list["Axes"]]:
    """A figure with that many panels.

    Args:
        number: of panels.
        height: of a row of panels (inches).
        columns: panels side by side; unset, all.
        width: of a panel (inches).
    """
    from matplotlib.figure import Figure

    columns = columns or number
    rows = -(-number // columns)
    figure = Figure(figsize=(width * columns, height * rows), dpi=DPI, layout="constrained")
    places = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in places:
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8.5)
    for axes in places[number:]:
        axes.set_visible(False)
    return figure, places[:number]


def _number(cell: str | None) -> float:
    try:
        return float(cell or "nan")
    except ValueError:
        return float("nan")
