"""Baseline policies behind one signature: `policy(key, state) -> action`.

The key belongs to the episode, not to the step: a policy that wants fresh draws folds the
time into it. Rules read the track list, the scan map and the clock, never the truths.

    policy = POLICIES["index"](static, params)
    action = policy(key, state)

Numbers of a rule are keywords of its builder: `partial(index, exponent=2.0)` is a builder too.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxtrack.beam_means import beam_means
from jaxtrack.kernel import one_by_one
from jaxtrack.models import elevation_bearing_range
from jaxtrack.observation import complete, variances
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import draw_index, first_largest
from jaxtrack.scan_map import beam_sizes, look_grid
from jaxtrack.search_plan import search_plan
from jaxtrack.sensor import frames, in_beams_of, look_number
from jaxtrack.types import Tracks, position

if TYPE_CHECKING:
    from jaxtrack.episode import EnvState

Policy = Callable[[jax.Array, "EnvState"], jax.Array]
PolicyBuilder = Callable[[StaticParams, Params], Policy]

REVISIT_SHARE = 0.6
"""The scheduler rule revisits a track whose trace passes this share of the threshold."""

TUNED_EXPONENT, TUNED_SCAN_WEIGHT, TUNED_SHARPNESS, TUNED_POSITION_WEIGHT = 0.33, 6.0, 3, 10.0
"""The index rule's numbers with the smallest GOSPA of eight on 200 default scenarios, not beyond chance."""


def random(static: StaticParams, params: Params) -> Policy:
    """A look drawn uniformly at every step (paper)."""

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        return to_action(draw_index(key, state.time, static.num_looks**2), static, params)

    return policy


def static(static: StaticParams, params: Params) -> Policy:
    """One look drawn uniformly at the start and kept (paper)."""

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del state
        return to_action(jax.random.randint(key, (), 0, static.num_looks**2), static, params)

    return policy


def coverage(static: StaticParams, params: Params) -> Policy:
    """Scans line by line: azimuth first, back and forth, elevation rising (paper)."""

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        line, place = jnp.divmod(state.time, static.num_looks)
        azimuth = jnp.where(line % 2 == 0, place, static.num_looks - 1 - place)
        index = azimuth * static.num_looks + line % static.num_looks
        return to_action(index, static, params)

    return policy


def stalest(static: StaticParams, params: Params) -> Policy:
    """The look whose beam has the largest mean scan value."""
    scan_values = beam_means(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        return to_action(first_largest(scan_values(state.scan_map)), static, params)

    return policy


def scheduler(
    static: StaticParams, params: Params, *, revisit_share: float | jax.Array = REVISIT_SHARE
) -> Policy:
    """Revisits the most uncertain track once it is urgent, else looks at the stalest cell.

    Args:
        static: shapes.
        params: numbers.
        revisit_share: share of the deletion threshold from which a trace is urgent.
    """
    scan_values = beam_means(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        share = trace_share(state.tracks, params)
        worst = first_largest(share)
        towards_track = nearest_look(state.tracks.mean[worst], static, params)
        stalest_look = first_largest(scan_values(state.scan_map))
        index = jnp.where(share[worst] > revisit_share, towards_track, stalest_look)
        return to_action(index, static, params)

    return policy


def index(
    static: StaticParams,
    params: Params,
    *,
    exponent: float | jax.Array = 1.0,
    scan_weight: float | jax.Array = 1.0,
    sharpness: float | jax.Array = 1,
    position_weight: float | jax.Array = 1.0,
) -> Policy:
    """The look with the largest index.

    The index of a look is the mean scan value in its beam plus, summed over the tracks in it,
    trace / deletion threshold.

    Args:
        static: shapes.
        params: numbers.
        exponent: power of each trace / deletion threshold.
        scan_weight: weight of the mean scan value.
        sharpness: power of the mean scan value; a high one tells what was never seen from the rest.
        position_weight: weight of the position's part of a trace.
    """
    scan_values = beam_means(static, params)
    looks = look_grid(static, params)

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        share = trace_share(state.tracks, params, position_weight) ** exponent
        urgency = sum_in_beams(share, state.tracks, looks, params)
        value = scan_weight * scan_values(state.scan_map) ** sharpness + urgency
        return to_action(first_largest(value), static, params)

    return policy


def gain(
    static: StaticParams,
    params: Params,
    *,
    sharpness: int = 16,
    area_exponent: float = 0.5,
    variance_scale: float = 1000.0,
    danger_weight: float = 3.0,
    danger_exponent: int = 8,
    planned: bool = False,
    tracked_weight: float = 1.0,
) -> Policy:
    """The look with the largest gain.

    The gain of a look is the field it finds unseen, plus, summed over the tracks in its beam, the
    position variance P that a detection with noise of variance R would remove, ``P - P R / (P + R)``,
    and the danger that the track is deleted soon, a high power of trace / deletion threshold.

    Args:
        static: shapes.
        params: numbers.
        sharpness: power of every scan value; a high one counts only what was never seen, or long ago.
        area_exponent: power of the beam's size in the field, per median of all looks; 1 counts the
            area that is found unseen, 0 its share of the beam. Beams hold more far from the horizon.
        variance_scale: removed variance that is worth as much as a beam of field never seen (m^2).
        danger_weight: worth of a track that is about to be deleted.
        danger_exponent: power of trace / deletion threshold.
        planned: the look whose turn it is in the search plan finds as much as the best.
        tracked_weight: weight of searching while there are as many confirmed tracks as there can be truths.
    """
    looks, sizes = look_grid(static, params), beam_sizes(static, params)
    areas = (sizes / jnp.median(sizes)) ** area_exponent
    scan_values = beam_means(static, params)
    plan = search_plan(static, params) if planned else None

    def policy(key: jax.Array, state: "EnvState") -> jax.Array:
        del key
        tracks = state.tracks
        distance = jnp.linalg.norm(position(tracks.mean), axis=-1)
        removed = removed_variance(variances(tracks)[:, 0], distance, params)
        danger = trace_share(tracks, params) ** danger_exponent
        need = removed / variance_scale + danger_weight * danger
        unseen = scan_values(state.scan_map**sharpness)
        found = plan.prefer_next(areas * unseen, unseen) if plan else areas * unseen
        found *= jnp.where(complete(tracks, static, params), tracked_weight, 1.0)
        return to_action(first_largest(found + sum_in_beams(need, tracks, looks, params)), static, params)

    return policy


POLICIES: dict[str, PolicyBuilder] = {
    "random": random,
    "static": static,
    "coverage": coverage,
    "stalest": stalest,
    "scheduler": scheduler,
    "index": index,
    "index_tuned": partial(
        index,
        exponent=TUNED_EXPONENT,
        scan_weight=TUNED_SCAN_WEIGHT,
        sharpness=TUNED_SHARPNESS,
        position_weight=TUNED_POSITION_WEIGHT,
    ),
    "gain": gain,
    "sweep": partial(gain, planned=True),
    "sweep_then_track": partial(gain, planned=True, tracked_weight=0.003),
}


def to_action(index: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Action `[2]` of look `index`: two indices, or two angles (rad) where actions are continuous."""
    if static.continuous_actions:
        return look_grid(static, params)[index]
    return jnp.stack([index // static.num_looks, index % static.num_looks])


def nearest_look(mean: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Index of the discrete look nearest in angle to a track's mean `[6]`."""
    elevation, azimuth, _ = elevation_bearing_range(mean)
    return look_number(jnp.stack([azimuth, elevation]), static, params)


def trace_share(tracks: Tracks, params: Params, position_weight: float | jax.Array = 1.0) -> jax.Array:
    """Covariance trace, its position part weighted, over the deletion threshold `[T]`; 0 without a track."""
    of_position, of_velocity = jnp.moveaxis(variances(tracks), -1, 0)
    trace = position_weight * of_position + of_velocity
    return jnp.where(tracks.active, trace / params.deletion_threshold, 0.0)


def removed_variance(of_position: jax.Array, distance: jax.Array, params: Params) -> jax.Array:
    """Position variance (m^2) that one more detection would remove: ``P^2 / (P + R)``.

    Sums over the three axes stand for P, the track's variance, and for R, that of a detection.

    Args:
        of_position: P of each track, the sum over the axes (m^2).
        distance: of each track from the radar (m).
        params: numbers; the noise of the radar.
    """
    across = params.elevation_sigma**2 + params.bearing_sigma**2
    noise = distance**2 * across + params.range_sigma**2
    return of_position**2 / (of_position + noise)


def sum_in_beams(values: jax.Array, tracks: Tracks, looks: jax.Array, params: Params) -> jax.Array:
    """Sum `[A]` of the values `[T]` of the live tracks in the beam of each of `looks` `[A, 2]`."""
    return one_by_one(_sum_over_tracks)(values, position(tracks.mean), tracks.active, frames(looks), params)


def _sum_over_tracks(
    values: jax.Array, points: jax.Array, active: jax.Array, of_looks: tuple[jax.Array, ...], params: Params
) -> jax.Array:
    """Track by track: an empty slot costs a CPU nothing."""

    def add(track: jax.Array, total: jax.Array) -> jax.Array:
        return total + jnp.where(in_beams_of(points[track], of_looks, params), values[track], 0.0)

    def add_if_alive(track: jax.Array, total: jax.Array) -> jax.Array:
        return jax.lax.cond(active[track], add, lambda track, total: total, track, total)

    return jax.lax.fori_loop(0, active.size, add_if_alive, jnp.zeros_like(of_looks[0], values.dtype))
