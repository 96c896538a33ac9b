"""What one more of something costs: straight lines through measured costs, and their figure."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Axis:
    """Something of which a scenario can have more.

    Attributes:
        name: of the option and of the field of the scenario.
        label: what the values are, for the figure.
        unit: what costs something.
        power: number of units of a value: the value to this power.
        per_step_of_all: whether the cost is that of a step of all environments, or of one.
        line: whether a straight line is fitted.
    """

    name: str
    label: str
    unit: str
    power: int = 1
    per_step_of_all: bool = False
    line: bool = True


AXES = (
    Axis("num_envs", "environments", "environment", per_step_of_all=True),
    Axis("max_tracks", "track slots", "track slot"),
    Axis("max_detections", "detection slots", "detection slot"),
    Axis("num_truths", "truths", "truth"),
    Axis("map_size", "pixels along each side of the scan map", "pixel of the map", power=2),
    Axis("devices", "devices (cores)", "device", line=False),
)


def fit(units: Sequence[float], costs: Sequence[float]) -> dict[str, float]:
    """The straight line with the smallest squares of relative errors, so that small costs count too.

    Returns:
        `one_more`, the cost of one unit; `fixed`, the cost of none; `largest_misfit`, the largest
        error of the line as a share of the cost measured.
    """
    measured = np.asarray(costs, float)
    terms = np.stack([np.asarray(units, float), np.ones(len(measured))], axis=1) / measured[:, None]
    (slope, fixed), *_ = np.linalg.lstsq(terms, np.ones(len(measured)), rcond=None)
    misfit = np.max(np.abs(terms @ [slope, fixed] - 1))
    return {"one_more": float(slope), "fixed": float(fixed), "largest_misfit": float(misfit)}


def draw(rows: Sequence[dict[str, Any]], path: Path, note: str) -> None:
    """Draws a panel for each row: what was measured, its spread, and the line.

    Args:
        rows: of `benchmarks.scaling.make_row`.
        path: the picture; its suffix tells the format.
        note: machine and versions, for the foot of the figure.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = 3
    figure = Figure(figsize=(11, 3.4 * -(-len(rows) // columns)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = {axis.name: axis for axis in AXES}
    for place, row in enumerate(rows, start=1):
        panel = figure.add_subplot(-(-len(rows) // columns), columns, place)
        draw_panel(panel, row, axes[row["axis"]])
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
    figure.supxlabel(note, fontsize=8)
    figure.savefig(path, dpi=110)


def draw_panel(panel: Any, row: dict[str, Any], axis: Axis) -> None:
    """One axis of the scenario; black and white are enough to read it."""
    values = np.array(row["values"], float)
    costs = row["microseconds"]
    low, median = (np.array([cost[which] for cost in costs]) for which in ("min", "median"))
    if row["fit"]:
        fine = np.geomspace(values.min(), values.max(), 50)
        line = row["fit"]["fixed"] + row["fit"]["one_more"] * fine**axis.power
        panel.plot(fine, line, color="0.5", linestyle="--", label="fixed cost + number x cost of one more")
    panel.errorbar(
        values, low, yerr=[0 * low, median - low], color="black", marker="o", linestyle="none",
        capsize=3, label="smallest of the repeats, and up to their median",
    )  # fmt: skip
    if axis.per_step_of_all:
        panel.set_xscale("log")
        panel.set_yscale("log")
    else:
        panel.set_ylim(0, 1.6 * low.max())  # a disturbed case must not hide the others
    panel.set_xlabel(axis.label)
    panel.set_ylabel("µs per step of all" if axis.per_step_of_all else "µs per step of one environment")
    if not axis.line:
        panel.set_xticks(values)
    panel.grid(color="0.9")
