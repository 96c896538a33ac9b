"""SIAP metrics of a whole record: which truths are followed, by how many tracks, how well, how long.

Counterpart in Stone Soup: `SIAPMetrics` on the associations of `TrackToTruth`. A record is
`Truths` and `Tracks` whose leaves have a leading axis of K steps.

Of two associations that end last, the walk of `tracks_needed` takes the one whose present
stretch ends last; Stone Soup goes by the order of a set.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.metrics import begins, pairwise_distances
from jaxtrack.params import Params
from jaxtrack.track_to_truth import associate_tracks_to_truths, followed_until
from jaxtrack.types import Tracks, Truths, position, velocity


class SiapAtTimes(struct.PyTreeNode):
    """SIAP at every step, all `[K]`.

    Attributes:
        completeness: share of the living truths that are followed; 0 without truths.
        ambiguity: tracks that follow a truth, per followed truth; 1 without.
        spuriousness: share of the tracks that follow none; 0 without tracks.
        position_accuracy: mean position error over associations (m); 0 without.
        velocity_accuracy: mean velocity error over associations (m/s); 0 without.
    """

    completeness: jax.Array
    ambiguity: jax.Array
    spuriousness: jax.Array
    position_accuracy: jax.Array
    velocity_accuracy: jax.Array


class Siap(struct.PyTreeNode):
    """SIAP over a record; the first five are quotients of sums over all steps.

    Attributes:
        completeness: see `SiapAtTimes`, as the next four.
        ambiguity: 1 is best.
        spuriousness: 0 is best.
        position_accuracy: in m.
        velocity_accuracy: in m/s.
        track_change_rate: changes of track per second that a truth was followed (1/s).
        longest_segment: longest time that one track followed the truth, as a share of its life;
            separate stretches of the same track add up.
        at_times: the first five at every step.
    """

    completeness: jax.Array
    ambiguity: jax.Array
    spuriousness: jax.Array
    position_accuracy: jax.Array
    velocity_accuracy: jax.Array
    track_change_rate: jax.Array
    longest_segment: jax.Array
    at_times: SiapAtTimes


def siap(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Siap:
    """SIAP of a record.

    Args:
        truths: `[K, N, ...]`; a row is one truth. Stone Soup raises an error where a truth is
            absent inside one of its associations; here the error of such a step is left out.
        tracks: `[K, T, ...]`; a slot may hold one track after another.
        times: `[K]` times of the steps (s), rising.
        params: numbers of the metric.
    """
    begun = begins(tracks)
    stretches = associate_tracks_to_truths(truths, tracks, begun, params)
    until = followed_until(stretches, truths.alive.shape[1])
    steps = jnp.arange(until.shape[0])[:, None, None]
    together = until >= steps  # [K, T, N]
    counts = _counts(truths, tracks, together)
    at_times = _ratios(*counts)
    totals = _ratios(*(jnp.sum(count) for count in counts))

    last = _last_steps(begun)
    durations = jnp.diff(times)[:, None, None] * (until > steps)[:-1]  # [K - 1, T, N]
    followed_time = jnp.sum(jnp.max(durations, axis=1))
    changes = jnp.sum(jnp.maximum(tracks_needed(until, last, truths.alive) - 1, 0))
    longest = jnp.sum(_longest_times(durations, begun))
    return Siap(
        **vars(totals),
        track_change_rate=_quotient(changes, followed_time),
        longest_segment=_quotient(longest, jnp.sum(_lifetimes(truths.alive, times))),
        at_times=at_times,
    )


def tracks_needed(until: jax.Array, last: jax.Array, alive: jax.Array) -> jax.Array:
    """`[N]` tracks that a truth passes through, by Stone Soup's greedy walk over its life.

    On the first step with a track, the walk takes the track that will be seen last with the
    truth, stays with it to the end of its present stretch, and goes on from there. It breaks
    off, as Stone Soup's does, when it arrives on the very last step of a stretch.

    Args:
        until: `[K, T, N]` of `followed_until`.
        last: `[K, T]` last step of the present or next track of the slot.
        alive: `[K, N]`.
    """
    num_steps = until.shape[0]
    steps = jnp.arange(num_steps)
    together = until >= steps[:, None, None]
    finally_ = jnp.where(together, jnp.take_along_axis(until, last[..., None], axis=0), -1)
    chosen = together & (finally_ == jnp.max(finally_, axis=1, keepdims=True))
    stretch_end = jnp.max(jnp.where(chosen, until, -1), axis=1)  # [K, N]

    def walk(carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, ...]) -> tuple:
        count, resume = carry
        step, end, lives = now
        taken = lives & (end >= step) & (step >= resume)
        resume = jnp.where(taken, jnp.where(end > step, end + 1, num_steps), resume)
        return (count + taken, resume), None

    zero = jnp.zeros(alive.shape[1], dtype=int)
    return jax.lax.scan(walk, (zero, zero), (steps, stretch_end, alive))[0][0]


def _counts(truths: Truths, tracks: Tracks, together: jax.Array) -> tuple[jax.Array, ...]:
    """J, JT, N, NA, sums of position and velocity errors: all `[K]`."""

    def errors(part: Callable[[jax.Array], jax.Array]) -> jax.Array:
        distances = jax.vmap(pairwise_distances)(part(tracks.mean), part(truths.state))
        return jnp.sum(jnp.where(present, distances, 0.0), axis=(1, 2))

    present = together & tracks.active[:, :, None] & truths.alive[:, None]
    return (
        jnp.sum(truths.alive, axis=-1),
        jnp.sum(jnp.any(together, axis=1), axis=-1),
        jnp.sum(tracks.active, axis=-1),
        jnp.sum(jnp.any(together, axis=2), axis=-1),
        errors(position),
        errors(velocity),
    )


def _ratios(
    truths: jax.Array,
    followed: jax.Array,
    tracks: jax.Array,
    following: jax.Array,
    position_error: jax.Array,
    velocity_error: jax.Array,
) -> SiapAtTimes:
    """The five quotients of `_counts`, or of their sums."""
    return SiapAtTimes(
        completeness=_quotient(followed, truths),
        ambiguity=_quotient(following, followed, otherwise=1.0),
        spuriousness=_quotient(tracks - following, tracks),
        position_accuracy=_quotient(position_error, following),
        velocity_accuracy=_quotient(velocity_error, following),
    )


def _longest_times(durations: jax.Array, begun: jax.Array) -> jax.Array:
    """`[N]` longest time (s) that one track spent with a truth, over all its stretches."""

    def one_step(carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, jax.Array]) -> tuple:
        spent, longest = carry  # [T, N] by the present tracks, [N]
        duration, begins = now
        spent = jnp.where(begins[:, None], 0.0, spent) + duration
        return (spent, jnp.maximum(longest, jnp.max(spent, axis=0))), None

    nothing = jnp.zeros(durations.shape[1:])
    return jax.lax.scan(one_step, (nothing, nothing[0]), (durations, begun[:-1]))[0][1]


def _last_steps(begun: jax.Array) -> jax.Array:
    """`[K, T]` step before the slot's next beginning, which is the last of its present track."""
    num_steps = begun.shape[0]
    at = jnp.where(begun, jnp.arange(num_steps)[:, None], num_steps)
    later = jnp.concatenate([at[1:], jnp.full_like(at[:1], num_steps)])
    return jax.lax.cummin(later, axis=0, reverse=True) - 1


def _lifetimes(alive: jax.Array, times: jax.Array) -> jax.Array:
    """`[N]` time (s) between the first and the last step of a truth; 0 if it never lives."""
    last = alive.shape[0] - 1 - jnp.argmax(alive[::-1], axis=0)
    return jnp.where(jnp.any(alive, axis=0), times[last] - times[jnp.argmax(alive, axis=0)], 0.0)


def _quotient(numerator: jax.Array, denominator: jax.Array, otherwise: float = 0.0) -> jax.Array:
    """Quotient, or `otherwise` where the denominator is 0."""
    empty = denominator == 0
    return jnp.where(empty, otherwise, numerator / jnp.where(empty, 1, denominator))
