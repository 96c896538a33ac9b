"""SIAP metrics of a whole record: which truths are followed, by how many tracks, how well, how long.

Counterpart in Stone Soup: `SIAPMetrics` on the associations of `TrackToTruth`. A record is
`Truths` and `Tracks` whose leaves have a leading axis of K steps.

Of two associations that end last, the walk of `tracks_needed` takes the one whose present
stretch ends last; Stone Soup goes by the order of a set.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.kernel import add_up, one_by_one
from jaxtrack.metrics import begins, pairwise_distances
from jaxtrack.params import Params
from jaxtrack.track_to_truth import Stretch, associate_tracks_to_truths
from jaxtrack.types import NO_TRUTH, Tracks, Truths, position, velocity

LARGEST_IN_ONE_KERNEL = 1000
"""Pairs of truth and track slot. Records with more are gone through together: sums over so many are
not for one kernel."""
_NEVER = -1


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


class _Behind(NamedTuple):
    """What `_look_back` remembers of later steps, for every slot and truth `[T, N]`.

    `start` and `end` are those of the stretch found last, which is the earliest; the others are of
    the slot's present track: the last step of its last stretch, and its time (s) with the truth.
    """

    start: jax.Array
    end: jax.Array
    final: jax.Array
    spent: jax.Array


class _View(NamedTuple):
    """What holds for all steps from `since` on to the one on which it was found.

    Attributes:
        together: `[T, N]` whether the slot's track follows the truth.
        going_on: `[T, N]` whether it does so until the next step, too.
        stretch_end: `[N]` see `tracks_needed`.
        since: `[]` the first step.
    """

    together: jax.Array
    going_on: jax.Array
    stretch_end: jax.Array
    since: jax.Array


class _Found(NamedTuple):
    """What one step of `_look_back` finds.

    Attributes:
        counts: J, JT, N, NA, sums of position and velocity errors, as `_ratios` takes them.
        followed: time (s) to the next step, summed over the truths that are followed until then.
        stretch_end: `[N]` see `tracks_needed`.
    """

    counts: tuple[jax.Array, ...]
    followed: jax.Array
    stretch_end: jax.Array


def _over_record(
    truths: Truths, tracks: Tracks, durations: jax.Array, params: Params
) -> tuple[tuple[jax.Array, ...], jax.Array, jax.Array, jax.Array]:
    """Of a record: counts `[K]`, followed times `[K]`, longest times `[N]`, changes of track `[N]`."""
    begun = begins(tracks)
    stretches = associate_tracks_to_truths(truths, tracks, begun, params)
    found, longest = _look_back(truths, tracks, begun, stretches, durations)
    changes = jnp.maximum(tracks_needed(found.stretch_end, truths.alive) - 1, 0)
    return found.counts, found.followed, longest, changes


def _look_back(
    truths: Truths, tracks: Tracks, begun: jax.Array, stretches: Stretch, durations: jax.Array
) -> tuple[_Found, jax.Array]:
    """Goes from the last step to the first: a stretch is known from its end on.

    Args:
        truths: `[K, N, ...]`.
        tracks: `[K, T, ...]`.
        begun: `[K, T]` where a slot takes up a new track.
        stretches: `[K + 1, T]` of `associate_tracks_to_truths`.
        durations: `[K]` time to the next step (s).

    Returns:
        What each step finds, `[K, ...]`, and the longest time (s) of a track with every truth `[N]`.
    """
    num_steps, num_truths = truths.alive.shape
    max_tracks = begun.shape[1]

    def one_step(carry: _Carry, now: Any) -> tuple[_Carry, _Found]:
        truths, tracks, begins, closed, duration, step = now
        # A track follows its truth for hundreds of steps, on which nothing changes but errors.
        changes = jnp.any(closed.truth != NO_TRUTH) | (step < carry.view.since)
        carry = jax.lax.cond(changes, _look_anew, lambda carry, *_: carry, carry, closed, step)
        carry = carry._replace(waiting=carry.waiting + duration)
        found = _Found(
            counts=_counts(truths, tracks, carry.view.together),
            followed=duration * jnp.sum(jnp.any(carry.view.going_on, axis=0)),
            stretch_end=carry.view.stretch_end,
        )
        return jax.lax.cond(jnp.any(begins), _forget, lambda carry, _: carry, carry, begins), found

    never = jnp.full((max_tracks, num_truths), _NEVER)
    nothing = jnp.zeros((max_tracks, num_truths), durations.dtype)
    nowhere = jnp.zeros_like(never, dtype=bool)
    start = _Carry(
        behind=_Behind(never, never, never, nothing),
        view=_View(nowhere, nowhere, never[0], jnp.asarray(num_steps)),
        waiting=nothing[0, 0],
        longest=nothing[0],
    )
    steps = jnp.arange(num_steps)
    closed = jax.tree.map(lambda leaf: leaf[1:], stretches)
    rows = (truths, tracks, begun, closed, durations, steps)
    carry, found = jax.lax.scan(one_step, start, rows, reverse=True)
    return found, _spend(carry).longest


class _Carry(NamedTuple):
    """What `_look_back` takes from step to step.

    Attributes:
        behind: what is remembered of each pair.
        view: which of them are together.
        waiting: `[]` time (s) with this view that `behind` does not have yet.
        longest: `[N]` longest time (s) of a track with the truth.
    """

    behind: _Behind
    view: _View
    waiting: jax.Array
    longest: jax.Array


def _spend(carry: _Carry) -> _Carry:
    """Puts the waiting time down to the pairs that were together."""
    spent = carry.behind.spent + jnp.where(carry.view.going_on, carry.waiting, 0.0)
    longest = jnp.maximum(carry.longest, jnp.max(spent, axis=0))
    return carry._replace(
        behind=carry.behind._replace(spent=spent), waiting=jnp.zeros_like(carry.waiting), longest=longest
    )


def _look_anew(carry: _Carry, closed: Stretch, step: jax.Array) -> _Carry:
    """Takes up what was closed on the step after this one, and who is together now."""
    carry = _spend(carry)
    behind = _take_up(carry.behind, closed)
    started = behind.start <= step
    together = started & (step <= behind.end)
    # The next step back on which something changes: a start is left, an end is met, or was met now.
    change = jnp.where(together, behind.start - 1, _NEVER)
    change = jnp.where(started & (behind.end <= step), behind.end - (behind.end == step), change)
    view = _View(
        together, together & (step < behind.end), _stretch_end(behind, together), jnp.max(change) + 1
    )
    return carry._replace(behind=behind, view=view)


def _forget(carry: _Carry, begins: jax.Array) -> _Carry:
    """Before its first step a slot held another track, or none."""
    carry = _spend(carry)
    behind = carry.behind
    final = jnp.where(begins[:, None], _NEVER, behind.final)
    spent = jnp.where(begins[:, None], 0.0, behind.spent)
    return carry._replace(behind=behind._replace(final=final, spent=spent))


def _take_up(behind: _Behind, closed: Stretch) -> _Behind:
    """Adds the stretches `[T]` that were closed on the step after this one."""
    new = closed.truth[:, None] == jnp.arange(behind.end.shape[1])
    end = jnp.where(new, closed.end[:, None], behind.end)
    return behind._replace(
        start=jnp.where(new, closed.start[:, None], behind.start),
        end=end,
        final=jnp.where(new & (behind.final == _NEVER), end, behind.final),
    )


def _stretch_end(behind: _Behind, together: jax.Array) -> jax.Array:
    """`[N]` end of the present stretch of the track that is seen last with the truth; -1 without one."""
    final = jnp.where(together, behind.final, _NEVER)
    chosen = together & (final == jnp.max(final, axis=0))
    return jnp.max(jnp.where(chosen, behind.end, _NEVER), axis=0)


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


def _counts(truths: Truths, tracks: Tracks, together: jax.Array) -> tuple[jax.Array, ...]:
    """J, JT, N, NA, sums of position and velocity errors of one step; `together` is `[T, N]`."""
    present = together & tracks.active[:, None] & truths.alive

    def errors(part: Callable[[jax.Array], jax.Array]) -> jax.Array:
        distances = pairwise_distances(part(tracks.mean), part(truths.state))
        return jnp.sum(add_up(jnp.where(present, distances, 0.0)))

    return (
        jnp.sum(truths.alive),
        jnp.sum(jnp.any(together, axis=0)),
        jnp.sum(tracks.active),
        jnp.sum(jnp.any(together, axis=1)),
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


def _lifetimes(alive: jax.Array, times: jax.Array) -> jax.Array:
    """`[N]` time (s) between the first and the last step of a truth; 0 if it never lives."""
    last = alive.shape[0] - 1 - jnp.argmax(alive[::-1], axis=0)
    return jnp.where(jnp.any(alive, axis=0), times[last] - times[jnp.argmax(alive, axis=0)], 0.0)


def _quotient(numerator: jax.Array, denominator: jax.Array, otherwise: float = 0.0) -> jax.Array:
    """Quotient, or `otherwise` where the denominator is 0."""
    empty = denominator == 0
    return jnp.where(empty, otherwise, numerator / jnp.where(empty, 1, denominator))
