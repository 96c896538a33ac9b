"""Figures of a comparison: over time, against each other, and where the radar looked.

They read in grey: policies differ in line style and in shade, intervals are bands. matplotlib is
imported on first use.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxtrack.params import Params
from train import plots
from train.episode_metrics import CURVES, METRICS
from train.episodes import Played
from train.results import RANKED, Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STYLES = (
    "-",
    "--",
    "-.",
    ":",
    (0, (7, 2)),
    (0, (4, 1, 1, 1, 1, 1)),
    (0, (1, 3)),
    (0, (9, 3, 2, 3)),
    (0, (5, 1)),
)
SHADES = ("0.0", "0.45", "0.25", "0.6")
COVARIANCE = ("covariance_x", "covariance_y", "covariance_z", "covariance_norm")
GOSPA = ("gospa", "gospa_localisation", "gospa_missed", "gospa_false")
DARK = 0.6
"""Share of the largest value above which a cell is so dark that its text is white."""
LABEL_GAP = 0.07
"""Least distance between direct labels, as a share of the height."""
LARGEST_MOVE = 2.5
"""Gaps by which a direct label may be moved up from the end of its curve."""

FIGURES = {
    "comparison": "Mean of every policy and its 95 % interval.",
    "covariance": "Mean over live tracks of the variance along each axis and of the covariance norm, "
    "averaged over the episodes that have a track at that time; bands are 95 % intervals of that mean.",
    "gospa": "GOSPA and its three parts over time; bands are 95 % intervals of the mean.",
    "improvement": "Probability that the policy of the row beats that of the column on a scenario, by GOSPA; "
    "below it the 95 % interval.",
    "looks": "Share of the dwells in each look; every map has its own scale, from none (white) to its "
    "largest share (black, in the title). Spread evenly, every look would have 100 % / number of looks.",
}
"""Figures by name, with what they show."""


def draw_all(played: Mapping[str, Played], summary: Summary, params: Params, folder: Path) -> dict[str, Path]:
    """Draws every figure of `FIGURES` as a PNG file; their paths by name."""
    paths = {name: folder / f"{name}.png" for name in FIGURES}
    titles = {metric: f"{METRICS[metric]}\n{direction(metric)}" for metric in RANKED}
    plots.comparison(summary.mean, titles, paths["comparison"])
    over_time(played, COVARIANCE, params, paths["covariance"])
    over_time(played, GOSPA, params, paths["gospa"])
    improvement(summary, "gospa", paths["improvement"])
    looks(played, params, paths["looks"])
    return paths


def direction(metric: str) -> str:
    """Which way is good for a metric of `RANKED`, in words."""
    return f"{'less' if RANKED[metric] else 'more'} is better"


def over_time(
    played: Mapping[str, Played], names: Sequence[str], params: Params, out_png: str | Path
) -> None:
    """Draws curves of all policies, a panel per name, with bands.

    Args:
        played: the policies; trained ones are drawn in colour and thicker.
        names: of `CURVES`, four at most.
        params: for the length of a step.
        out_png: picture to write.
    """
    figure, panels = plots.panels(len(names), height=3.0, columns=2, width=4.6)
    for axes, name in zip(panels, names, strict=True):
        ends: dict[str, float] = {}
        for number, (policy, one) in enumerate(played.items()):
            curve = one.curves[name]
            time = params.time_step * np.arange(1, len(curve.mean) + 1)
            style = line_style(number, trained=bool(one.seeds))
            axes.fill_between(time, curve.low, curve.high, color=style["color"], alpha=0.15, lw=0)
            axes.plot(time, curve.mean, label=policy, **style)
            known = np.flatnonzero(np.isfinite(curve.mean))
            ends |= {policy: curve.mean[known[-1]]} if known.size else {}
        axes.set_title(CURVES[name], fontsize=9.5)
        axes.set_xlabel("time (s)", fontsize=9)
        axes.set_xlim(0, params.time_step * len(curve.mean))
        # Where everything is zero, as false tracks without clutter, the scale must not be noise.
        axes.set_ylim(0, None if any(value > 0 for value in ends.values()) else 1)
        axes.grid(color="0.92")
        label_ends(axes, ends)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(
        *handles, loc="outside lower center", ncols=min(len(played), 5), fontsize=8.5, handlelength=3.5
    )
    figure.savefig(out_png)


def line_style(number: int, trained: bool) -> dict[str, Any]:
    """Style and shade of the policy of that number."""
    style = STYLES[number % len(STYLES)]
    if trained:
        return {"color": plots.COLOUR, "lw": 2.0, "ls": style}
    return {"color": SHADES[number % len(SHADES)], "lw": 1.2, "ls": style}


def label_ends(axes: "Axes", ends: Mapping[str, float]) -> None:
    """Writes policies' names to the right of their curves' ends, moved apart where they would touch.

    A name that would come to stand far from its curve is left to the legend.
    """
    low, high = axes.get_ylim()
    height = (high - low) * LABEL_GAP
    place = low - height
    for policy, value in sorted(ends.items(), key=lambda entry: entry[1]):
        beside = max(value, place + height)
        if beside > value + LARGEST_MOVE * height:
            continue
        place = beside
        at = (1.015, (place - low) / (high - low))
        axes.annotate(policy, at, xycoords="axes fraction", fontsize=7.5, va="center", annotation_clip=False)


def improvement(summary: Summary, metric: str, out_png: str | Path) -> None:
    """Draws the matrix of probabilities that the row's policy beats the column's.

    Args:
        summary: the estimates.
        metric: of `RANKED`.
        out_png: picture to write.
    """
    matrix = summary.improvement[metric]
    names = list(matrix)
    size = 1.8 + 0.75 * len(names)
    figure, (axes,) = plots.panels(1, height=0.8 + 0.62 * len(names), width=size)
    values = np.array([[matrix[a][b].value if a != b else np.nan for b in names] for a in names])
    axes.imshow(values, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    for i, a in enumerate(names):
        for j, b in enumerate(names):
            if a != b:
                value, low, high = matrix[a][b]
                words = f"{value:.2f}\n{low:.2f}–{high:.2f}"  # noqa: RUF001
                colour = "white" if value > DARK else "black"
                axes.text(j, i, words, ha="center", va="center", fontsize=7.5, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.spines[:].set_visible(False)
    axes.set_title(
        f"probability that the row beats the column\n{METRICS[metric]}, {direction(metric)}", fontsize=9.5
    )
    figure.savefig(out_png)


def looks(played: Mapping[str, Played], params: Params, out_png: str | Path) -> None:
    """Draws where every policy looked: azimuth to the right, elevation up.

    Args:
        played: the policies.
        params: for the limits of the field.
        out_png: picture to write.
    """
    limit = np.degrees(float(params.field_limit))
    figure, panels = plots.panels(len(played), height=2.9, columns=min(4, len(played)))
    for place, (axes, (policy, one)) in enumerate(zip(panels, played.items(), strict=True)):
        # Of [azimuth, elevation], elevation is the row of a picture.
        half = limit / (len(one.looks) - 1)
        edge = limit + half
        extent = (-edge, edge, -edge, edge)
        axes.imshow(one.looks.T, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=one.looks.max())
        axes.set_title(f"{policy}\nup to {100 * one.looks.max():.2g} % of dwells", fontsize=9)
        axes.set_xlabel("azimuth (°)", fontsize=8.5)
        if place % 4 == 0:
            axes.set_ylabel("elevation (°)", fontsize=8.5)
        axes.set_xticks([-60, 0, 60] if round(limit) == 60 else [-round(limit), 0, round(limit)])
        axes.set_yticks(axes.get_xticks())
    figure.savefig(out_png)
