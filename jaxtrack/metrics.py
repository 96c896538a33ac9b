"""How good a track list is, given the truths: for evaluation, never for the agent."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.assignment import assign
from jaxtrack.kernel import add_up, one_by_one, stage
from jaxtrack.observation import covariance_norms
from jaxtrack.params import Params
from jaxtrack.types import Scalar, Tracks, Truths, position


class Gospa(struct.PyTreeNode):
    """GOSPA with alpha = 2 (Stone Soup's `GOSPAMetric`), positions only.

    The three parts are p-th powers. Without switching, ``distance = (localisation + missed +
    false)^(1/p)``; with it, ``distance = sqrt(distance^2 + switching^2)`` whatever p is, as
    Stone Soup has it.

    Attributes:
        distance: the metric (m).
        localisation: sum of d^p over assigned pairs closer than the cut-off (m^p).
        missed: c^p/2 for every truth without a track (m^p).
        false: c^p/2 for every track without a truth (m^p).
        switching: penalty for truths whose track changed (m); 0 for a single step.
    """

    distance: jax.Array
    localisation: jax.Array
    missed: jax.Array
    false: jax.Array
    switching: jax.Array


class GospaHistory(struct.PyTreeNode):
    """Which track every truth was last assigned to, for the switching penalty.

    Attributes:
        seen: `[N]` whether the truth was ever assigned a track.
        has_track: `[N]` whether it was on the last step that counted.
        birth_step: `[N]` birth step of that track.
        birth_detection: `[N]` birth detection of that track.
    """

    seen: jax.Array  # [N] bool
    has_track: jax.Array  # [N] bool
    birth_step: jax.Array  # [N] int
    birth_detection: jax.Array  # [N] int

    @classmethod
    def empty(cls, num_truths: int) -> "GospaHistory":
        """Before the first step."""
        no, nothing = jnp.zeros(num_truths, dtype=bool), jnp.zeros(num_truths, dtype=int)
        return cls(no, no, nothing, nothing)


def position_distances(truths: Truths, tracks: Tracks) -> jax.Array:
    """Distances `[N, T]` (m) of every truth from every track; infinite where one is absent."""
    distances = pairwise_distances(position(truths.state), position(tracks.mean))
    return jnp.where(truths.alive[:, None] & tracks.active[None], distances, jnp.inf)


@stage
def nearest(distances: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distance and number `[T]` of the truth nearest to every track, the first of equals, of `[N, T]`."""
    Row = tuple[jax.Array, jax.Array]

    def nearer(a: Row, b: Row) -> Row:
        return jnp.minimum(a[0], b[0]), jnp.where(b[0] < a[0], b[1], a[1])

    # Truth by truth for all tracks at once: a CPU works out `jnp.argmin` number by number.
    rows = [(row, jnp.asarray(number)) for number, row in enumerate(jnp.unstack(distances))]
    return functools.reduce(nearer, rows)


def pairwise_distances(a: jax.Array, b: jax.Array) -> jax.Array:
    """Euclidean distances `[N, T]` of vectors `[N, 3]` from vectors `[T, 3]`."""
    return jnp.sqrt(add_up((a[:, None] - b[None]) ** 2, axis=-1))


def gospa(truths: Truths, tracks: Tracks, params: Params) -> Gospa:
    """GOSPA between truths and live tracks of one step, by an exact assignment."""
    return _gospa(truths, tracks, params)[0]


def gospa_step(
    history: GospaHistory, truths: Truths, tracks: Tracks, params: Params
) -> tuple[GospaHistory, Gospa]:
    """GOSPA of the next step of a record, switching penalty included.

    Stone Soup's `GOSPAMetric.compute_over_time`: a truth that passes from one track to another
    counts 1, one that gains or loses its track 1/2 (its first track is free), and the penalty
    is ``gospa_switching_penalty * count^(1/p)``. A truth that is absent, and every truth on a
    step without a single track, keeps its history and counts nothing.

    Args:
        history: `GospaHistory.empty(N)` before the first step.
        truths: the truths of this step; a row is one truth for the whole record.
        tracks: the tracks of this step, recognised by birth step and birth detection.
        params: numbers of the metric.

    Returns:
        The history after this step, and the metric.
    """
    single, assigned = _gospa(truths, tracks, params)
    has_track, slot = jnp.any(assigned, axis=1), jnp.argmax(assigned, axis=1)
    birth_step, birth_detection = tracks.birth_step[slot], tracks.birth_detection[slot]
    counts = truths.alive & jnp.any(tracks.active)

    passed = (birth_step != history.birth_step) | (birth_detection != history.birth_detection)
    passed = counts & has_track & history.has_track & passed
    gained_or_lost = counts & history.seen & (has_track != history.has_track)
    switches = jnp.sum(passed) + jnp.sum(gained_or_lost) / 2
    switching = params.gospa_switching_penalty * switches ** (1 / params.gospa_order)

    history = GospaHistory(
        seen=history.seen | (counts & has_track),
        has_track=jnp.where(counts, has_track, history.has_track),
        birth_step=jnp.where(counts, birth_step, history.birth_step),
        birth_detection=jnp.where(counts, birth_detection, history.birth_detection),
    )
    distance = jnp.sqrt(single.distance**2 + switching**2)
    return history, single.replace(distance=distance, switching=switching)


def gospa_over_time(truths: Truths, tracks: Tracks, params: Params) -> Gospa:
    """GOSPA `[K]` of every step of a record, switching penalty included (see `gospa_step`).

    Args:
        truths: `[K, N, ...]`.
        tracks: `[K, T, ...]`.
        params: numbers of the metric.
    """

    def step(history: GospaHistory, now: tuple[Truths, Tracks]) -> tuple[GospaHistory, Gospa]:
        return gospa_step(history, *now, params)

    start = GospaHistory.empty(truths.alive.shape[1])
    return jax.lax.scan(step, start, (truths, tracks))[1]


def _gospa(truths: Truths, tracks: Tracks, params: Params) -> tuple[Gospa, jax.Array]:
    """GOSPA of one step, and which truths and tracks are assigned to each other, `[N, T]`."""
    c, p = params.gospa_cutoff, params.gospa_order
    distances = position_distances(truths, tracks)
    assigned = one_by_one(_match)(*jax.lax.stop_gradient((distances, c, p)))
    # A track has one truth at most.
    close, error = jnp.any(assigned, axis=0), jnp.sum(jnp.where(assigned, distances, 0.0), axis=0)
    localisation = jnp.sum(jnp.where(close, jnp.where(close, error, 1.0) ** p, 0.0))
    missed = (jnp.sum(truths.alive) - jnp.sum(close)) * c**p / 2
    false = (jnp.sum(tracks.active) - jnp.sum(close)) * c**p / 2
    distance = (localisation + missed + false) ** (1 / p)
    return Gospa(distance, localisation, missed, false, jnp.zeros_like(distance)), assigned


def _match(distances: jax.Array, cutoff: Scalar, order: Scalar) -> jax.Array:
    """Which pairs closer than the cut-off the cheapest assignment of `distances` `[N, T]` makes."""
    close = distances < cutoff
    pairs = jnp.sum(close)
    contested = (jnp.sum(jnp.any(close, axis=0)) < pairs) | (jnp.sum(jnp.any(close, axis=1)) < pairs)

    def cheapest() -> jax.Array:
        slot = assign(jnp.where(close, distances / cutoff, 1.0) ** order)
        return close & (jnp.arange(close.shape[1]) == slot[:, None])

    # Mostly no two compete: then all that are close are pairs.
    return jax.lax.cond(contested, cheapest, lambda: close)


class BasicMetrics(struct.PyTreeNode):
    """How many tracks and truths a record holds (Stone Soup's `BasicMetrics`).

    Attributes:
        num_tracks: distinct tracks that ever lived.
        num_truths: truths that ever lived; Stone Soup's "Number of targets".
        track_to_target_ratio: the first by the second. Deletion and re-initiation raise it.
        mean_ratio: live tracks by living truths, averaged over the steps with a truth; not in
            Stone Soup.
    """

    num_tracks: jax.Array
    num_truths: jax.Array
    track_to_target_ratio: jax.Array
    mean_ratio: jax.Array


def basic_metrics(truths: Truths, tracks: Tracks) -> BasicMetrics:
    """Counts of a record: truths `[K, N, ...]` and tracks `[K, T, ...]`; without a truth, per 1."""
    num_tracks = jnp.sum(begins(tracks))
    num_truths = jnp.sum(jnp.any(truths.alive, axis=0))
    alive, active = jnp.sum(truths.alive, axis=-1), jnp.sum(tracks.active, axis=-1)
    ratios = jnp.where(alive > 0, active / jnp.maximum(alive, 1), 0.0)
    return BasicMetrics(
        num_tracks=num_tracks,
        num_truths=num_truths,
        track_to_target_ratio=num_tracks / jnp.maximum(num_truths, 1),
        mean_ratio=jnp.sum(ratios) / jnp.maximum(jnp.sum(alive > 0), 1),
    )


def begins(tracks: Tracks) -> jax.Array:
    """`[K, T]` whether a slot of a record `[K, T, ...]` holds a track that it did not hold before.

    A slot may hold one track after another: they differ in birth step or birth detection.
    """
    return one_by_one(_begins)(tracks.active, tracks.birth_step, tracks.birth_detection)


def _begins(*rows: jax.Array) -> jax.Array:
    def one_step(last: tuple[jax.Array, ...], now: tuple[jax.Array, ...]) -> tuple[Any, jax.Array]:
        used, birth_step, birth_detection = last
        active, step, detection = now
        begun = active & (~used | (step != birth_step) | (detection != birth_detection))
        last = (
            used | active,
            jnp.where(active, step, birth_step),
            jnp.where(active, detection, birth_detection),
        )
        return last, begun

    return jax.lax.scan(one_step, tuple(jnp.zeros_like(row[0]) for row in rows), rows)[1]


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
    # Track by track for all truths at once: a CPU takes minima along the last axis number by number.
    norms = jnp.where(near.T, covariance_norms(tracks)[:, None], params.deletion_threshold)
    best = jnp.minimum(jnp.min(norms, axis=0), params.deletion_threshold)
    total = jnp.sum(jnp.where(truths.alive, best, 0.0))
    return total / jnp.maximum(jnp.sum(truths.alive), 1)


def covariance_norm_sum(tracks: Tracks) -> jax.Array:
    """Sum over live tracks of the covariance norm: Stone Soup's `SumofCovarianceNormsMetric`."""
    return jnp.sum(jnp.where(tracks.active, covariance_norms(tracks), 0.0))


def covariance_norm_mean(tracks: Tracks) -> jax.Array:
    """Mean over live tracks of the covariance norm; 0 without tracks."""
    return covariance_norm_sum(tracks) / jnp.maximum(jnp.sum(tracks.active), 1)


StepMetric = Callable[[Truths, Tracks, Params], jax.Array]

METRICS: dict[str, StepMetric] = {
    "gospa": lambda truths, tracks, params: gospa(truths, tracks, params).distance,
    "gospa_localisation": lambda truths, tracks, params: gospa(truths, tracks, params).localisation,
    "gospa_missed": lambda truths, tracks, params: gospa(truths, tracks, params).missed,
    "gospa_false": lambda truths, tracks, params: gospa(truths, tracks, params).false,
    "completeness": completeness,
    "uncertainty_per_truth": uncertainty_per_truth,
    "covariance_norm_sum": lambda truths, tracks, params: covariance_norm_sum(tracks),
    "covariance_norm_mean": lambda truths, tracks, params: covariance_norm_mean(tracks),
}
"""Metrics of one step by name: for `info`, as a stop criterion, and for one's own reward."""
