"""Picture of tracks: seen from above, and height over time. matplotlib is imported on first use."""

from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from jaxtrack.detection_file import MICROSECONDS, RecordedDetections
from jaxtrack.models import inverse_elevation_bearing_range
from jaxtrack.tracking import TrackRows
from jaxtrack.types import NO_DETECTION, POSITION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".pdf", ".svg")
DPI = 130
DOTS = 20_000
"""Detections drawn at most: evenly taken from all."""
TRACK = "#0b3c8c"


class TrackPaths:
    """Collects where the tracks were, for a picture.

    Args:
        recorded: the detections that are tracked.
    """

    def __init__(self, recorded: RecordedDetections) -> None:
        self.recorded = recorded
        self.since_start = (recorded.time - recorded.time[0]) / MICROSECONDS
        self.parts: list[np.ndarray] = []

    def add(self, rows: TrackRows) -> None:
        """Takes the next rows."""
        columns = [rows.track, rows.detection != NO_DETECTION, self.since_start[rows.scan]]
        self.parts.append(np.stack([*columns, *rows.mean[:, POSITION].T], axis=1))

    def lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Tracks with one detection only, and the others.

        Both are time (s) and position (m) `[L, 4]` along every track, with a row of NaN after each.
        """
        rows = np.concatenate([np.zeros((0, 6)), *self.parts])
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        track = rows[:, 0].astype(int)
        confirmed = (np.bincount(track, weights=rows[:, 1]) > 1)[track]
        return _with_gaps(rows[~confirmed]), _with_gaps(rows[confirmed])

    def dots(self) -> np.ndarray:
        """Time (s) and position (m) `[at most DOTS, 4]` of detections, thinned evenly."""
        chosen = np.arange(0, len(self.recorded.value), -(-len(self.recorded.value) // DOTS) or 1)
        times = np.repeat(self.since_start, self.recorded.count)[chosen]
        points = np.asarray(inverse_elevation_bearing_range(jnp.asarray(self.recorded.value[chosen])))
        return np.concatenate([times[:, None], points], axis=1)

    def draw(self) -> "Figure":
        """The figure: from above on the left, height over time on the right."""
        from matplotlib.figure import Figure

        brief, lines = self.lines()
        dots = self.dots()
        places = np.concatenate([brief, lines, dots])[:, 1:]
        scale, unit = (1000.0, "km") if np.nanmax(np.abs(places), initial=0.0) >= 2000 else (1.0, "m")
        brief, lines, dots = (array / [1, scale, scale, scale] for array in (brief, lines, dots))
        figure = Figure(figsize=(10.5, 5.2), dpi=DPI, layout="constrained")
        above, height = figure.subplots(1, 2)
        for axes, columns in ((above, [1, 2]), (height, [0, 3])):
            _draw(axes, brief[:, columns], lines[:, columns], dots[:, columns])
        above.plot(0, 0, "k^", ms=6, zorder=4, label="radar")
        above.set_aspect("equal", adjustable="datalim")
        above.set(xlabel=f"x, forward ({unit})", ylabel=f"y, left ({unit})")
        height.set(xlabel="time since the first scan (s)", ylabel=f"z, height ({unit})")
        shown = "" if len(dots) == len(self.recorded.value) else f", {len(dots):,} drawn"
        above.set_title(f"from above: {_count(lines) + _count(brief):,} tracks", fontsize=10)
        height.set_title(f"height: {len(self.recorded.value):,} detections{shown}", fontsize=10)
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
        return figure

    def save(self, path: Path) -> None:
        """Writes the picture in the format that the suffix names."""
        self.draw().savefig(path)


def _draw(axes: "Axes", brief: np.ndarray, lines: np.ndarray, dots: np.ndarray) -> None:
    # Light, middle, dark: told apart in grey too.
    axes.plot(*dots.T, ".", color="0.78", ms=2, rasterized=True, label="detection", zorder=1)
    axes.plot(*brief.T, color="0.5", lw=0.6, label="track with one detection", zorder=2)
    axes.plot(*lines.T, color=TRACK, lw=1.2, label="track", zorder=3)
    axes.grid(color="0.93")
    axes.tick_params(labelsize=8.5)
    axes.spines[["top", "right"]].set_visible(False)


def _with_gaps(rows: np.ndarray) -> np.ndarray:
    """The last four columns, a row of NaN after the last row of each track (the first column)."""
    ends = np.flatnonzero(np.diff(rows[:, 0], append=-1)) + 1
    return np.insert(rows[:, 2:], ends, np.nan, axis=0)


def _count(lines: np.ndarray) -> int:
    return int(np.isnan(lines[:, 0]).sum())
