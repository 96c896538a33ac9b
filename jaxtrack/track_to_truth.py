"""Which track follows which truth, over a whole record.

Counterpart in Stone Soup: `TrackToTruth`, with positions only. A track belongs to the truth
that was nearest to it, within a threshold, for some steps in a row, from the first of these
steps to the last such step before it was away for some steps in a row. Being decided later and
dated back, that exists for records only; `follow` alone can be carried from step to step.

Where several truths are equally near, the lowest wins; Stone Soup goes by the order of a set.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.metrics import nearest, position_distances
from jaxtrack.params import Params
from jaxtrack.types import NO_TRUTH, Scalar, Tracks, Truths


class Following(struct.PyTreeNode):
    """What `TrackToTruth` remembers of every track slot.

    Attributes:
        truth: `[T]` truth that the track belongs to, or `NO_TRUTH`.
        start: `[T]` step from which on it does.
        end: `[T]` last step on which that truth was the nearest.
        misses: `[T]` steps in a row since then.
        candidate: `[T]` truth that may be next, or `NO_TRUTH`.
        candidate_start: `[T]` step on which it became so.
        candidate_hits: `[T]` steps on which it was the nearest.
    """

    truth: jax.Array
    start: jax.Array
    end: jax.Array
    misses: jax.Array
    candidate: jax.Array
    candidate_start: jax.Array
    candidate_hits: jax.Array

    @classmethod
    def nobody(cls, max_tracks: int) -> "Following":
        """For slots whose tracks belong to no truth."""
        none, zero = jnp.full(max_tracks, NO_TRUTH), jnp.zeros(max_tracks, dtype=int)
        return cls(none, zero, zero, zero, none, zero, zero)


class Stretch(struct.PyTreeNode):
    """Steps from `start` to `end`, both included, during which a track followed `truth`.

    Attributes:
        truth: `[T]` or `[K + 1, T]`; `NO_TRUTH` where nothing ended.
        start: same shape, step.
        end: same shape, step.
    """

    truth: jax.Array
    start: jax.Array
    end: jax.Array


def follow(
    following: Following, nearest: jax.Array, step: Scalar, params: Params
) -> tuple[Following, Stretch]:
    """One step of `TrackToTruth` for every slot that holds a track.

    Args:
        following: the memory after the previous step.
        nearest: `[T]` truth nearest to the track and within the threshold, or `NO_TRUTH`.
        step: number of this step.
        params: numbers of the metric.

    Returns:
        The memory after this step, and the stretches that ended.
    """
    idle = following.truth == NO_TRUTH
    hit = ~idle & (nearest == following.truth)
    again = (nearest == following.candidate) & (nearest != NO_TRUTH)
    hits = jnp.where(again, following.candidate_hits + 1, 1)
    hits = jnp.where(hit, following.candidate_hits, hits)
    candidate = jnp.where(hit, following.candidate, nearest)
    candidate_start = jnp.where(hit | again, following.candidate_start, step)
    # As in Stone Soup a new association inherits the misses that ended the one before: until
    # its first hit after confirmation, a single miss ends it.
    misses = jnp.where(idle, following.misses, jnp.where(hit, 0, following.misses + 1))

    ended = ~idle & ~hit & (misses >= params.siap_end_steps)
    # Hits of the candidate need not be in a row while the track belongs to another truth.
    confirmed = (idle | ended) & (hits >= params.siap_confirm_steps)
    kept = jnp.where(ended, NO_TRUTH, following.truth)
    after = Following(
        truth=jnp.where(confirmed, candidate, kept),
        start=jnp.where(confirmed, candidate_start, following.start),
        end=jnp.where(confirmed | hit, step, following.end),
        misses=misses,
        candidate=jnp.where(confirmed, NO_TRUTH, candidate),
        candidate_start=candidate_start,
        candidate_hits=jnp.where(confirmed, 0, hits),
    )
    return after, _close(following, ended)


def associate_tracks_to_truths(truths: Truths, tracks: Tracks, begun: jax.Array, params: Params) -> Stretch:
    """All stretches of a record `[K + 1, T]`, in the row of the step on which they were closed.

    Args:
        truths: `[K, N, ...]`.
        tracks: `[K, T, ...]`.
        begun: `[K, T]` where a slot takes up a new track (`metrics.begins`).
        params: numbers of the metric.
    """
    num_steps, max_tracks = begun.shape
    nobody = Following.nobody(max_tracks)

    def one_step(following: Following, now: tuple[Any, ...]) -> tuple[Following, Stretch]:
        truths, tracks, begins, step = now
        nearest = nearest_truth(truths, tracks, params)
        settled = ~begins & (~tracks.active | (nearest == following.truth) & (nearest != NO_TRUTH))

        def go_on() -> tuple[Following, Stretch]:
            end = jnp.where(tracks.active, step, following.end)
            misses = jnp.where(tracks.active, 0, following.misses)
            return following.replace(end=end, misses=misses), _close(following, begins)

        def change() -> tuple[Following, Stretch]:
            left = _close(following, begins)
            known = _choose(begins, nobody, following)
            after, ended = follow(known, nearest, step, params)
            closed = _choose(begins, left, _choose(tracks.active, ended, left))
            return _choose(tracks.active, after, known), closed

        # Mostly every track is again nearest to the truth that it follows: `follow` says no more then.
        return jax.lax.cond(jnp.all(settled), go_on, change)

    steps = jnp.arange(num_steps)
    end, closed = jax.lax.scan(one_step, nobody, (truths, tracks, begun, steps))
    still_open = _close(end, jnp.ones(max_tracks, dtype=bool))
    return jax.tree.map(lambda rows, row: jnp.concatenate([rows, row[None]]), closed, still_open)


def nearest_truth(truths: Truths, tracks: Tracks, params: Params) -> jax.Array:
    """`[T]` truth nearest to every track and closer than the threshold, or `NO_TRUTH`."""
    distance, truth = nearest(position_distances(truths, tracks))
    return jnp.where(distance < params.siap_threshold, truth, NO_TRUTH)


def _close(following: Following, ends: jax.Array) -> Stretch:
    """The present stretches of the slots in `ends` `[T]`."""
    return Stretch(jnp.where(ends, following.truth, NO_TRUTH), following.start, following.end)


def _choose(mask: jax.Array, on_true: Any, on_false: Any) -> Any:
    """Slot by slot one record or the other."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), on_true, on_false)
