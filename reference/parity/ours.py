"""Our tracker on the same scenarios: every step from the oracle's state, and free-running."""

from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import tracker
from jaxtrack.lifecycle import no_tracks
from jaxtrack.params import Params, StaticParams
from jaxtrack.tracker import DEFAULT, TrackerInfo
from jaxtrack.types import Detections, Tracks
from reference.parity.scenarios import Scenario

MAX_TRACKS = 64
"""Track slots: far more than any scenario here needs, as Stone Soup has no limit."""

Tree = TypeVar("Tree")


def steps_from(before: Tracks, scenario: Scenario, double: bool = True) -> tuple[Tracks, TrackerInfo]:
    """One step from each of K track lists; K results on the host.

    Args:
        before: `[K, T]` track lists, those of the oracle.
        scenario: the K scans, and the numbers of the tracker.
        double: whether in float64 or in float32.
    """
    index = np.arange(1, len(scenario.detections.value) + 1)
    return on_device(_steps_from, double, before, scenario.detections, index, scenario.params)


def episode(
    scenario: Scenario, double: bool = True, static: StaticParams = DEFAULT
) -> tuple[Tracks, TrackerInfo]:
    """The whole scenario from an empty track list; `[K]` results on the host."""
    play = partial(track_detections, max_tracks=MAX_TRACKS, static=static)
    return on_device(play, double, scenario.detections, scenario.params)


def on_device(function: Any, double: bool, *arguments: Any) -> Any:
    """Calls a jitted function in one precision and fetches what it returns."""
    with jax.enable_x64(double):
        return jax.device_get(function(*cast(arguments, double)))


def cast(tree: Tree, double: bool) -> Tree:
    """Every floating-point leaf in float64 or float32, numbers of `Params` included."""
    kind = np.float64 if double else np.float32

    def convert(leaf: Any) -> Any:
        array = np.asarray(leaf)
        return array.astype(kind) if np.issubdtype(array.dtype, np.floating) else array

    return jax.tree.map(convert, tree)


@jax.jit
def _steps_from(
    before: Tracks, detections: Detections, index: jax.Array, params: Params
) -> tuple[Tracks, TrackerInfo]:
    def one(tracks: Tracks, scan: Detections, index: jax.Array) -> tuple[Tracks, TrackerInfo]:
        return tracker.step(tracks, scan, params.time_step, index, params)

    return jax.vmap(one)(before, detections, index)


@partial(jax.jit, static_argnames=("max_tracks", "static"))
def track_detections(
    detections: Detections, params: Params, max_tracks: int, static: StaticParams = DEFAULT
) -> tuple[Tracks, TrackerInfo]:
    """The tracker on detections `[K, D]` from an empty list of `max_tracks` slots; results `[K]`."""

    def one(carry: tuple[Tracks, jax.Array], scan: Detections) -> tuple[Any, Any]:
        tracks, index = carry
        tracks, info = tracker.step(tracks, scan, params.time_step, index, params, static)
        return (tracks, index + 1), (tracks, info)

    start = no_tracks(max_tracks, static), jnp.asarray(1)
    return jax.lax.scan(one, start, detections)[1]
