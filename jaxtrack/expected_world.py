"""The expected world, in which sensor managers plan: every look finds what it should.

A look detects every live track whose predicted mean lies in its beam, exactly where it is
expected, and the detection belongs to that track. So covariances fall as the filter says, means
stay predicted, nothing is random and no truth is read. No track is ever found there: what search
may find pays only through the scan map. And no track is ever missed: one that has lost its truth,
or shares it with another, is looked at again and again until it is deleted.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from jaxtrack import kalman
from jaxtrack.beam_means import beam_means
from jaxtrack.env import one_by_one_if_small
from jaxtrack.lifecycle import delete_uncertain_tracks
from jaxtrack.observation import confirmed, covariance_norms, variances
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import sum_in_beams
from jaxtrack.reward import TRACK_TERMS, reward_terms
from jaxtrack.scan_map import beam_sizes, mean_scan_value, update_scan_map
from jaxtrack.sensor import in_beam, look_angles
from jaxtrack.types import Detections, Tracks, Truths, position, where_rows

if TYPE_CHECKING:
    from jaxtrack.episode import EnvState

BeamSums = Callable[[jax.Array], jax.Array]
"""Map `[M, M]` to its sum over the pixels in the beam of every look `[L * L]`."""


def beam_pixels(static: StaticParams, params: Params) -> BeamSums:
    """The sums over the pixels in the beam of every look of `look_grid`."""
    means, sizes = beam_means(static, params), beam_sizes(static, params)
    return lambda scan_map: sizes * means(scan_map)


def expected_rewards(
    state: "EnvState",
    looks: jax.Array,
    pixels: BeamSums,
    static: StaticParams,
    params: Params,
) -> jax.Array:
    """Expected reward `[A]` of the next step for every look.

    Tracks are predicted and updated once; a look is then a choice between two worths of every
    track, and the share of the map that it clears.

    Args:
        state: the present state; its truths are not read.
        looks: `[A, 2]` boresights (rad).
        pixels: sums over the map in the beams of these looks.
        static: shapes, and the reward.
        params: numbers.
    """
    predicted, updated = expected_outcomes(state.tracks, params)
    missed = _worths(state.tracks, predicted, static, params)
    gained = _worths(state.tracks, updated, static, params) - missed
    track = jnp.sum(missed) + sum_in_beams(gained, predicted, looks, params)
    aged = update_scan_map(state.scan_map, jnp.full(2, jnp.nan), static, params)  # NaN looks nowhere
    sharp = aged**static.search_sharpness
    scan_value = mean_scan_value(sharp) - pixels(sharp) / sharp.size
    if static.search_until_complete:
        scan_value = jnp.where(_completes(predicted, updated, looks, static, params), 0.0, scan_value)
    return params.track_weight * track - params.search_weight * scan_value


def expected_falls(tracks: Tracks, looks: jax.Array, params: Params) -> jax.Array:
    """Fall `[A]` of the covariance norm by the update, summed over the tracks in the beam of every look.

    Stone Soup's `UncertaintyRewardFunction`.
    """
    predicted, updated = expected_outcomes(tracks, params)
    fall = covariance_norms(predicted) - covariance_norms(updated)
    return sum_in_beams(fall, predicted, looks, params)


def expected_step(
    state: "EnvState", action: jax.Array, static: StaticParams, params: Params
) -> tuple["EnvState", jax.Array]:
    """One step of the expected world: the state after it, truths untouched, and the reward."""
    look = look_angles(action, static, params)
    tracks = one_by_one_if_small(_expected_tracks, static)(state.tracks, look, params)
    scan_map = update_scan_map(state.scan_map, look, static, params)
    track, search = reward_terms(state.tracks, tracks, _no_truths(), scan_map, static, params)
    return state.replace(time=state.time + 1, tracks=tracks, scan_map=scan_map), track + search


def expected_outcomes(tracks: Tracks, params: Params) -> tuple[Tracks, Tracks]:
    """The track list one step on, if no track is detected and if all are; nothing is deleted."""
    predicted = kalman.predict(tracks, params.time_step, params)
    return predicted, _update_all(predicted, params)


def _expected_tracks(tracks: Tracks, look: jax.Array, params: Params) -> Tracks:
    """The track list after a look `[2]` (rad) in the expected world."""
    predicted = kalman.predict(tracks, params.time_step, params)
    detected = predicted.active & in_beam(position(predicted.mean), look, params)

    def update() -> Tracks:
        updated = _update_all(predicted, params)
        return jax.tree.map(lambda a, b: where_rows(detected, a, b), updated, predicted)

    return delete_uncertain_tracks(jax.lax.cond(jnp.any(detected), update, lambda: predicted), params)


def _update_all(predicted: Tracks, params: Params) -> Tracks:
    """Every predicted track updated with its expected detection."""
    expected = kalman.predict_detections(predicted, params)
    own = jnp.arange(predicted.active.shape[0])
    return kalman.update(predicted, expected, Detections.from_values(expected.mean), own)


def _worths(before: Tracks, after: Tracks, static: StaticParams, params: Params) -> jax.Array:
    """Track term of the reward, track by track `[T]`: the term is a sum over them."""
    term, after = TRACK_TERMS[static.reward], delete_uncertain_tracks(after, params)
    # Track lists of one track each.
    alone = jax.tree.map(lambda leaf: leaf[:, None], (before, after))
    return jax.vmap(lambda before, after: term(before, after, _no_truths(), static, params))(*alone)


def _completes(
    predicted: Tracks, updated: Tracks, looks: jax.Array, static: StaticParams, params: Params
) -> jax.Array:
    """`[A]` whether after a look there are as many confirmed tracks as there can be truths."""

    def sure(tracks: Tracks) -> jax.Array:
        left = delete_uncertain_tracks(tracks, params)
        return confirmed(left.active, variances(left)[:, 1], params).astype(float)

    missed, detected = sure(predicted), sure(updated)
    return jnp.sum(missed) + sum_in_beams(detected - missed, predicted, looks, params) >= static.num_truths


def _no_truths() -> Truths:
    return Truths(state=jnp.zeros((0, 6)), alive=jnp.zeros(0, dtype=bool))
