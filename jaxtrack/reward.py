"""Rewards by name: pure functions of the track list before and after a step.

Every reward is ``track_weight * track term - search_weight * mean of scan value ** search_sharpness``;
they differ in the track term. Only `gospa` reads the truths, which no real radar knows. With
`search_until_complete` the search term is 0 while there is nothing left to find.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxtrack.metrics import gospa
from jaxtrack.observation import complete, covariance_norms
from jaxtrack.params import Params, StaticParams
from jaxtrack.scan_map import mean_scan_value
from jaxtrack.types import NO_DETECTION, Tracks, Truths

LOST_STEPS = 200.0
"""`shortfall`: a deleted track costs as much as this many steps of being as uncertain as can be."""

TrackTerm = Callable[[Tracks, Tracks, Truths, StaticParams, Params], jax.Array]


def covariance_reduction(
    before: Tracks, after: Tracks, truths: Truths, static: StaticParams, params: Params
) -> jax.Array:
    """Fall of the covariance norm, summed over tracks detected now or one step ago.

    The paper prints the difference the other way round, which pays for growth, while its
    text says reduction: this follows the text. Divided by the deletion threshold.
    """
    del truths
    detected = (after.updated_by != NO_DETECTION) | (before.updated_by != NO_DETECTION)
    # A track born now has no norm before; its slot may have held another track.
    counts = after.active & detected
    counts &= _same_tracks(before, after) if _can_enter_late(static) else after.age > 0
    fall = covariance_norms(before) - covariance_norms(after)
    return jnp.sum(jnp.where(counts, fall, 0.0)) / params.deletion_threshold


def covariance_growth(
    before: Tracks, after: Tracks, truths: Truths, static: StaticParams, params: Params
) -> jax.Array:
    """The paper's track term with the sign as printed."""
    return -covariance_reduction(before, after, truths, static, params)


def information(
    before: Tracks, after: Tracks, truths: Truths, static: StaticParams, params: Params
) -> jax.Array:
    """Sum over live tracks of ``max(0, 1 - trace(P) / threshold)``, per truth expected.

    Every live track is worth up to 1, a lost one nothing.
    """
    del before, truths
    trace = jnp.trace(after.covariance, axis1=-2, axis2=-1)
    worth = jnp.maximum(0.0, 1 - trace / params.deletion_threshold)
    return jnp.sum(jnp.where(after.active, worth, 0.0)) / static.num_truths


def shortfall(
    before: Tracks, after: Tracks, truths: Truths, static: StaticParams, params: Params
) -> jax.Array:
    """Minus the sum over live tracks of ``min(1, trace(P) / threshold)``, and a price for each deleted.

    Per truth expected. A new track is worth nothing here: to find truths pays by the search term
    alone, as much as there was to see, not by the luck of a truth being there. So it varies
    far less from episode to episode than `information`, and is easier to learn from.
    """
    del truths
    trace = jnp.trace(after.covariance, axis1=-2, axis2=-1)
    cost = jnp.minimum(1.0, trace / params.deletion_threshold)
    # A slot may hold a new track already.
    kept = after.active & (
        _same_tracks(before, after) if _can_enter_late(static) else after.birth_step == before.birth_step
    )
    deleted = jnp.sum(before.active & ~kept)
    return -(jnp.sum(jnp.where(after.active, cost, 0.0)) + LOST_STEPS * deleted) / static.num_truths


def accuracy(
    before: Tracks, after: Tracks, truths: Truths, static: StaticParams, params: Params
) -> jax.Array:
    """``1 - GOSPA / GOSPA without tracks``: 1 if the tracks are the truths, 0 without tracks.

    Negative where false tracks cost more than the true ones gain; without a living truth the
    divisor is that of one.
    """
    del before, static
    num_truths = jnp.maximum(jnp.sum(truths.alive), 1)
    worst = params.gospa_cutoff * (num_truths / 2) ** (1 / params.gospa_order)
    return 1 - gospa(truths, after, params).distance / worst


def _can_enter_late(static: StaticParams) -> bool:
    """Whether a track can enter the list some steps after its birth."""
    return static.initiator == "multi_measurement"


def _same_tracks(before: Tracks, after: Tracks) -> jax.Array:
    """`[T]` whether a slot held, before the step, the track that it holds after it."""
    same_step = before.birth_step == after.birth_step
    return before.active & same_step & (before.birth_detection == after.birth_detection)


TRACK_TERMS: dict[str, TrackTerm] = {
    "paper": covariance_reduction,
    "as_printed": covariance_growth,
    "information": information,
    "shortfall": shortfall,
    "gospa": accuracy,
}


def reward_terms(
    before: Tracks,
    after: Tracks,
    truths: Truths,
    scan_map: jax.Array,
    static: StaticParams,
    params: Params,
) -> tuple[jax.Array, jax.Array]:
    """Weighted track term and weighted search term (negative); the reward is their sum."""
    track = params.track_weight * TRACK_TERMS[static.reward](before, after, truths, static, params)
    search = -params.search_weight * mean_scan_value(scan_map, static.search_sharpness)
    if static.search_until_complete:
        search = jnp.where(complete(after, static, params), 0.0, search)
    return track, search
