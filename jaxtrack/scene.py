"""The drawing of one moment of a recorded episode. matplotlib is imported on first use."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack.models import direction, elevation_bearing_range, spherical, wrap_bearing
from jaxtrack.params import Params
from jaxtrack.recording import Episode
from jaxtrack.sensor import platform_frame

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

SIGMAS = 2
ENLARGED = 10
"""Ellipses are drawn this many times larger: in true size a good track is a single pixel."""
TRAIL_STEPS, TRAIL_POINTS = 1000, 40
"""How far back a truth's trail goes, and in how many points."""
SIZE, DPI = (8.0, 4.8), 100
"""Width and height of the picture (inches); 800 x 480 pixels."""
MAP_BOTTOM, MAP_HEIGHT = 0.4625, 0.4
PLAN_BOTTOM, PLAN_HEIGHT = 0.1, 0.2
FROM_ABOVE = (2, 0)
"""Places of y and x in a state: right and up in the plan."""
CORNERS = np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
SCAN_LEVELS = 8
"""Shades of the scan map; few of them keep a GIF small."""
COLOURS = ("#0b3c8c", "#2a9d8f", "#f4a261")
"""Of certain, middling and nearly deleted tracks."""


def beam_outline(look: jax.Array, params: Params) -> jax.Array:
    """Edge of the beam `[48, 2]` (azimuth, elevation in rad) of a look `[2]` (rad).

    The edge is a rectangle only in the boresight frame; in azimuth it widens with elevation.
    """
    along, one = jnp.linspace(-1.0, 1.0, 12), jnp.ones(12)
    bearing = params.beam_azimuth / 2 * jnp.concatenate([along, one, -along, -one])
    elevation = params.beam_elevation / 2 * jnp.concatenate([-one, along, one, -along])
    edge = spherical(platform_frame(direction(bearing, elevation), look))
    # Kept in one piece where bearings wrap at +-pi.
    azimuth = look[0] + wrap_bearing(edge[:, 1] - look[0])
    return jnp.stack([azimuth, edge[:, 0]], axis=-1)


def angles(states: jax.Array) -> jax.Array:
    """Azimuth and elevation `[..., 2]` (deg) of states `[..., 6]`."""
    return jnp.degrees(elevation_bearing_range(states)[..., 1::-1])


def angle_covariance(mean: jax.Array, covariance: jax.Array) -> jax.Array:
    """Covariance `[2, 2]` (deg^2) of the azimuth and elevation of a track: ``H P H^T``.

    Args:
        mean: `[6]` its state.
        covariance: `[6, 6]` that state's covariance.
    """
    H = jax.jacfwd(angles)(mean)
    return H @ covariance @ H.T


# Compiled once and called for all steps at once: frame by frame this would outlast the drawing.
_beam_outlines = jax.jit(jax.vmap(beam_outline, in_axes=(0, None)))
_angle_covariances = jax.jit(jax.vmap(jax.vmap(angle_covariance)))


def ellipses(centre: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Outlines `[T, 33, 2]`, enlarged, of covariances `[T, 2, 2]` about centres `[T, 2]`."""
    turn = np.linspace(0, 2 * np.pi, 33)
    size, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(size, 0))[:, None]
    outline = root @ np.stack([np.cos(turn), np.sin(turn)])
    return centre[:, None] + ENLARGED * SIGMAS * np.swapaxes(outline, -1, -2)


class Scene:
    """A figure of a recorded episode; `show` moves it to another step.

    Attributes:
        figure: a matplotlib `Figure` that belongs to no window and needs no closing.
        moving: the artists that `show` changes, in drawing order; everything else stands still.
    """

    def __init__(self, episode: Episode) -> None:
        """Lays the panels out; nothing of the episode shows before `show`."""
        from matplotlib.figure import Figure

        self.episode = episode
        truths, tracks = episode.states.truths, episode.states.tracks
        self.truths = np.where(truths.alive[..., None], truths.state, np.nan)
        self.outlines = np.degrees(_beam_outlines(episode.records.look, episode.params))
        self.truth_angles = np.asarray(angles(jnp.asarray(self.truths)))
        self.track_angles = np.asarray(angles(jnp.asarray(tracks.mean)))
        self.covariances = np.asarray(_angle_covariances(tracks.mean, tracks.covariance))
        self.figure = Figure(figsize=SIZE, dpi=DPI)
        self.headline = self.figure.text(0.075, 0.955, "", family="monospace", size=10, va="center")
        self.moving: list[Artist] = [self.headline]
        self._lay_out_field()
        self._lay_out_map()
        self._lay_out_plan()

    def _lay_out_field(self) -> None:
        from matplotlib.collections import PolyCollection

        axes = self.figure.add_axes((0.075, 0.21, 0.3915, 0.6525))
        limit = float(np.degrees(self.episode.params.field_limit))
        margin = 1.15 * limit
        axes.set(xlim=(-margin, margin), ylim=(-margin, margin), aspect="equal")
        _label(axes, "Field of the radar", "azimuth (deg)", "elevation (deg)")
        axes.plot(*limit * CORNERS, color="0.7", lw=0.8, ls=(0, (4, 3)))
        self.looks = PolyCollection([], facecolor="0.9", label="latest looks")
        axes.add_collection(self.looks)
        (self.beam,) = axes.fill([], [], facecolor="#ffd54d", edgecolor="0.25", lw=1.2, label="beam now")
        (self.trails,) = axes.plot([], [], color="0.6", lw=0.8)
        self.field_tracks = _Tracks(axes)
        (self.detections,) = axes.plot([], [], "k.", ms=3.5, label="latest detections")
        self.field_truths = _truth_markers(axes, 9, "truth, unknown to the radar")
        tracks = self.field_tracks.artists
        self.moving += [self.looks, self.beam, self.trails, *tracks, self.detections, self.field_truths]
        handles = [self.beam, self.looks, self.field_truths, self.field_tracks.handle(), self.detections]
        style: Any = {"loc": "lower left", "ncols": 2, "frameon": False, "fontsize": 8}
        style |= {"borderpad": 0, "handlelength": 1.4, "columnspacing": 1.5}
        self.figure.legend(handles=handles, bbox_to_anchor=(0.065, 0.005), **style)

    def _lay_out_map(self) -> None:
        from matplotlib import colormaps

        axes = self.figure.add_axes((0.6, MAP_BOTTOM, 0.24, MAP_HEIGHT))
        limit = float(np.degrees(self.episode.params.field_limit))
        style: Any = {"origin": "lower", "interpolation": "nearest", "vmin": 0, "vmax": 1}
        shades = colormaps["Greys_r"].resampled(SCAN_LEVELS)
        extent = (-limit, limit, -limit, limit)
        self.image = axes.imshow(np.ones((2, 2)), extent=extent, cmap=shades, **style)
        self.moving.append(self.image)
        _label(axes, "Scan map", "azimuth (deg)", "elevation (deg)")
        axes.set(xticks=(-limit, 0, limit), yticks=(-limit, 0, limit))
        self._add_bar(self.image, MAP_BOTTOM, MAP_HEIGHT, "scan value", "0 now", "1 long ago")

    def _lay_out_plan(self) -> None:
        axes = self.figure.add_axes((0.6, PLAN_BOTTOM, 0.24, PLAN_HEIGHT))
        reach = float(self.episode.params.max_range) / 1000
        axes.set(xlim=(-reach, reach), ylim=(0, reach), xticks=(-reach, 0, reach), yticks=(0, reach))
        _label(axes, "Seen from above", "y (km)", "x (km)")
        self.plan_tracks = _Tracks(axes)
        self.plan_truths = _truth_markers(axes, 6)
        self.moving += [*self.plan_tracks.artists, self.plan_truths]
        mapped = self.plan_tracks.centres
        self._add_bar(mapped, PLAN_BOTTOM, PLAN_HEIGHT, "uncertainty", "0 certain", "1 deleted")

    def _add_bar(self, mapped: Any, bottom: float, height: float, label: str, low: str, high: str) -> None:
        bar = self.figure.colorbar(mapped, cax=self.figure.add_axes((0.865, bottom, 0.016, height)))
        bar.set_ticks([0, 1], labels=[low, high], fontsize=8)
        bar.set_label(label, fontsize=8.5, labelpad=-22)

    def show(self, step: int, since: int | None = None, fresh_since: int | None = None) -> None:
        """Moves every mark to a step.

        Args:
            step: index into the episode.
            since: first step whose look is drawn faintly behind the beam.
            fresh_since: first step whose detections are drawn.
        """
        since = step if since is None else max(since, 0)
        fresh_since = since if fresh_since is None else max(fresh_since, 0)
        self._show_headline(step)
        self._show_looks(step, since)
        self._show_detections(step, fresh_since)
        self._show_truths(step)
        self._show_tracks(step)
        self.image.set_data(self.episode.states.scan_map[step])

    def _show_headline(self, step: int) -> None:
        episode = self.episode
        seconds = (step + 1) * float(episode.params.time_step)
        live = episode.states.tracks.active[step].sum()
        self.headline.set_text(
            f"time {seconds:.2f} s   look {step + 1:<4d}   tracks {live:<2d}   "
            f"truths tracked {episode.completeness[step]:<4.0%}   GOSPA distance {episode.gospa[step]:.0f} m"
        )

    def _show_looks(self, step: int, since: int) -> None:
        self.looks.set_verts(list(self.outlines[since:step]))
        self.beam.set_xy(self.outlines[step])

    def _show_detections(self, step: int, since: int) -> None:
        found = self.episode.records.detections
        kept = found.value[since : step + 1][found.active[since : step + 1]]
        self.detections.set_data(np.degrees(kept[:, 1]), np.degrees(kept[:, 0]))

    def _show_truths(self, step: int) -> None:
        start = max(step - TRAIL_STEPS, 0)
        past = np.unique(np.linspace(start, step, TRAIL_POINTS).astype(int))
        paths = self.truth_angles[past]
        # One line for all; the NaN at its end lifts the pen between truths.
        paths = np.concatenate([paths, np.full_like(paths[:1], np.nan)])
        self.trails.set_data(*paths.transpose(2, 1, 0).reshape(2, -1))
        self.field_truths.set_data(*self.truth_angles[step].T)
        self.plan_truths.set_data(*self.truths[step][:, FROM_ABOVE].T / 1000)

    def _show_tracks(self, step: int) -> None:
        tracks = jax.tree.map(lambda rows: rows[step], self.episode.states.tracks)
        live = tracks.active
        mean, covariance = tracks.mean[live], tracks.covariance[live]
        share = np.trace(covariance, axis1=-2, axis2=-1) / float(self.episode.params.deletion_threshold)
        self.field_tracks.show(self.track_angles[step][live], self.covariances[step][live], share)
        in_plane = covariance[:, FROM_ABOVE][:, :, FROM_ABOVE]
        self.plan_tracks.show(mean[:, FROM_ABOVE] / 1000, in_plane / 1000**2, share)


class _Tracks:
    """Tracks of one panel: a dot and an ellipse each, coloured by trace / deletion threshold."""

    def __init__(self, axes: "Axes") -> None:
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import LinearSegmentedColormap

        # Lightness rises all the way, so that the order survives in grey.
        colours = LinearSegmentedColormap.from_list("uncertainty", COLOURS)
        style: dict[str, Any] = {"cmap": colours, "clim": (0, 1)}
        self.outlines = PolyCollection([], lw=0, alpha=0.45, **style)
        axes.add_collection(self.outlines)
        self.centres = axes.scatter([], [], s=12, c=[], **style)
        self.artists: list[Artist] = [self.outlines, self.centres]

    def show(self, centre: np.ndarray, covariance: np.ndarray, uncertainty: np.ndarray) -> None:
        self.outlines.set_verts(list(ellipses(centre, covariance)))
        self.outlines.set_array(uncertainty)
        self.centres.set_offsets(centre)
        self.centres.set_array(uncertainty)

    def handle(self) -> Any:
        from matplotlib.lines import Line2D

        label = f"track, {SIGMAS}\u03c3 ellipse {ENLARGED}\u00d7 enlarged"
        return Line2D([], [], marker="o", ms=9, mfc=COLOURS[1], mec="none", alpha=0.6, ls="", label=label)


def _label(axes: "Axes", title: str, horizontal: str, vertical: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(horizontal, fontsize=8.5, labelpad=1)
    axes.set_ylabel(vertical, fontsize=8.5, labelpad=1)
    axes.tick_params(labelsize=8)


def _truth_markers(axes: "Axes", size: float, label: str = "") -> Any:
    return axes.plot([], [], "o", ms=size, mfc="none", mec="0.1", mew=1.0, label=label)[0]
