"""How good a track list is, given the truths: for evaluation, never for the agent."""

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxtrack.observation import covariance_norms
from jaxtrack.params import Params
from jaxtrack.types import Tracks, Truths, position


class Gospa(struct.PyTreeNode):
    """GOSPA with alpha = 2 (Stone Soup's `GOSPAMetric`), positions only.

    The three parts are p-th powers; ``distance = (localisation + missed + false)^(1/p)``.

    Attributes:
        distance: the metric (m).
        localisation: sum of d^p over assigned pairs closer than the cut-off (m^p).
        missed: c^p/2 for every truth without a track (m^p).
        false: c^p/2 for every track without a truth (m^p).
    """

    distance: jax.Array
    localisation: jax.Array
    missed: jax.Array
    false: jax.Array


def position_distances(truths: Truths, tracks: Tracks) -> jax.Array:
    """Distances `[N, T]` (m) of every truth from every track; infinite where one is absent."""
    offsets = position(truths.state)[:, None] - position(tracks.mean)[None]
    distances = jnp.sqrt(jnp.sum(offsets**2, axis=-1))
    return jnp.where(truths.alive[:, None] & tracks.active[None], distances, jnp.inf)


def gospa(truths: Truths, tracks: Tracks, params: Params) -> Gospa:
    """GOSPA between truths and live tracks by an exact assignment."""
    c, p = params.gospa_cutoff, params.gospa_order
    costs = jnp.minimum(position_distances(truths, tracks), c) ** p
    rows, columns = optax.assignment.hungarian_algorithm(costs)
    assigned = costs[rows, columns]
    close = assigned < c**p
    localisation = jnp.sum(jnp.where(close, assigned, 0.0))
    missed = (jnp.sum(truths.alive) - jnp.sum(close)) * c**p / 2
    false = (jnp.sum(tracks.active) - jnp.sum(close)) * c**p / 2
    return Gospa((localisation + missed + false) ** (1 / p), localisation, missed, false)


def completeness(truths: Truths, tracks: Tracks, params: Params) -> jax.Array:
    """Share of the living truths that have a track within the GOSPA cut-off."""
    covered = jnp.any(position_distances(truths, tracks) < params.gospa_cutoff, axis=-1)
    return jnp.sum(covered) / jnp.maximum(jnp.sum(truths.alive), 1)


def uncertainty_per_truth(truths: Truths, tracks: Tracks, params: Params) -> jax.Array:
    """Mean over living truths of the covariance norm of its best track (m^2, mixed units).

    The best track is the most certain one within the GOSPA cut-off; a truth without one
    counts the deletion threshold. Unlike the mean covariance norm it can not be improved by
    dropping tracks.
    """
    near = position_distances(truths, tracks) < params.gospa_cutoff
    norms = jnp.where(near, covariance_norms(tracks)[None], jnp.inf)
    best = jnp.minimum(jnp.min(norms, axis=-1), params.deletion_threshold)
    total = jnp.sum(jnp.where(truths.alive, best, 0.0))
    return total / jnp.maximum(jnp.sum(truths.alive), 1)


def covariance_norm_sum(tracks: Tracks) -> jax.Array:
    """Sum over live tracks of the covariance norm: Stone Soup's `SumofCovarianceNormsMetric`."""
    return jnp.sum(jnp.where(tracks.active, covariance_norms(tracks), 0.0))


def covariance_norm_mean(tracks: Tracks) -> jax.Array:
    """Mean over live tracks of the covariance norm; 0 without tracks."""
    return covariance_norm_sum(tracks) / jnp.maximum(jnp.sum(tracks.active), 1)
