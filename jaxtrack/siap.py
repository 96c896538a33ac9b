"""SIAP metrics of a whole record: which truths are followed, by how many tracks, how well, how long.

Counterpart in Stone Soup: `SIAPMetrics` on the associations of `TrackToTruth`. A record is
`Truths` and `Tracks` whose leaves have a leading axis of K steps.

Of two associations that end last, the walk of `tracks_needed` takes the one whose present
stretch ends last; Stone Soup goes by the order of a set.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.kernel import one_by_one
from jaxtrack.look_back import look_back
from jaxtrack.metrics import begins
from jaxtrack.params import Params
from jaxtrack.track_to_truth import associate_tracks_to_truths
from jaxtrack.types import Tracks, Truths

LARGEST_IN_ONE_KERNEL = 1000
"""Pairs of truth and track slot. Records with more are gone through together: sums over so many are
not for one kernel."""


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
    durations = jnp.diff(times, append=times[-1:])  # nothing comes after the last step
    pairs = truths.alive.shape[1] * tracks.active.shape[1]
    over_record = one_by_one(_over_record) if pairs <= LARGEST_IN_ONE_KERNEL else _over_record
    counts, followed_times, longest, changes = over_record(truths, tracks, durations, params)
    return Siap(
        **vars(_ratios(*(jnp.sum(count) for count in counts))),
        track_change_rate=_quotient(jnp.sum(changes), jnp.sum(followed_times)),
        longest_segment=_quotient(jnp.sum(longest), jnp.sum(_lifetimes(truths.alive, times))),
        at_times=_ratios(*counts),
    )


def _over_record(
    truths: Truths, tracks: Tracks, durations: jax.Array, params: Params
) -> tuple[tuple[jax.Array, ...], jax.Array, jax.Array, jax.Array]:
    """Of a record: counts `[K]`, followed times `[K]`, longest times `[N]`, changes of track `[N]`."""
    begun = begins(tracks)
    stretches = associate_tracks_to_truths(truths, tracks, begun, params)
    found, longest = look_back(truths, tracks, begun, stretches, durations)
    changes = jnp.maximum(tracks_needed(found.stretch_end, truths.alive) - 1, 0)
    return found.counts, found.followed, longest, changes


def tracks_needed(stretch_end: jax.Array, alive: jax.Array) -> jax.Array:
    """`[N]` tracks that a truth passes through, by Stone Soup's greedy walk over its life.

    On the first step with a track, the walk takes the track that will be seen last with the
    truth, stays with it to the end of its present stretch, and goes on from there. It breaks
    off, as Stone Soup's does, when it arrives on the very last step of a stretch.

    Args:
        stretch_end: `[K, N]` end of the present stretch of that track; -1 without one.
        alive: `[K, N]`.
    """
    num_steps = alive.shape[0]

    def walk(carry: tuple[jax.Array, jax.Array], now: tuple[jax.Array, ...]) -> tuple:
        count, resume = carry
        step, end, lives = now
        taken = lives & (end >= step) & (step >= resume)
        resume = jnp.where(taken, jnp.where(end > step, end + 1, num_steps), resume)
        return (count + taken, resume), None

    zero = jnp.zeros(alive.shape[1], dtype=int)
    return jax.lax.scan(walk, (zero, zero), (jnp.arange(num_steps), stretch_end, alive))[0][0]


def _ratios(
    truths: jax.Array,
    followed: jax.Array,
    tracks: jax.Array,
    following: jax.Array,
    position_error: jax.Array,
    velocity_error: jax.Array,
) -> SiapAtTimes:
    """The five quotients of `look_back`, or of their sums."""
    return SiapAtTimes(
        completeness=_quotient(followed, truths),
        ambiguity=_quotient(following, followed, otherwise=1.0),
        spuriousness=_quotient(tracks - following, tracks),
        position_accuracy=_quotient(position_error, following),
        velocity_accuracy=_quotient(velocity_error, following),
    )


def _lifetimes(alive: jax.Array, times: jax.Array) -> jax.Array:
    """`[N]` time (s) between the first and the last step of a truth; 0 if it never lives."""
    last = alive.shape[0] - 1 - jnp.argmax(alive[::-1], axis=0)
    return jnp.where(jnp.any(alive, axis=0), times[last] - times[jnp.argmax(alive, axis=0)], 0.0)


def _quotient(numerator: jax.Array, denominator: jax.Array, otherwise: float = 0.0) -> jax.Array:
    """Quotient, or `otherwise` where the denominator is 0."""
    empty = denominator == 0
    return jnp.where(empty, otherwise, numerator / jnp.where(empty, 1, denominator))
