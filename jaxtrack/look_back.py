"""Going through a record from its last step to its first: who is together when, and how well.

A stretch of `jaxtrack.track_to_truth` is known from its end on only, so that `jaxtrack.siap` looks back.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtrack.kernel import add_up
from jaxtrack.metrics import pairwise_distances
from jaxtrack.track_to_truth import Stretch
from jaxtrack.types import NO_TRUTH, Tracks, Truths, position, velocity

_NEVER = -1


class _Behind(NamedTuple):
    """What `look_back` remembers of later steps, for every slot and truth `[T, N]`.

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
        stretch_end: `[N]` see `jaxtrack.siap.tracks_needed`.
        since: `[]` the first step.
    """

    together: jax.Array
    going_on: jax.Array
    stretch_end: jax.Array
    since: jax.Array


class Found(NamedTuple):
    """What one step of `look_back` finds.

    Attributes:
        counts: J, JT, N, NA, sums of position and velocity errors, as `jaxtrack.siap` takes them.
        followed: time (s) to the next step, summed over the truths that are followed until then.
        stretch_end: `[N]` see `jaxtrack.siap.tracks_needed`.
    """

    counts: tuple[jax.Array, ...]
    followed: jax.Array
    stretch_end: jax.Array


class _Carry(NamedTuple):
    """What `look_back` takes from step to step.

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


def look_back(
    truths: Truths, tracks: Tracks, begun: jax.Array, stretches: Stretch, durations: jax.Array
) -> tuple[Found, jax.Array]:
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

    def one_step(carry: _Carry, now: Any) -> tuple[_Carry, Found]:
        truths, tracks, begins, closed, duration, step = now
        # A track follows its truth for hundreds of steps, on which nothing changes but errors.
        changes = jnp.any(closed.truth != NO_TRUTH) | (step < carry.view.since)
        carry = jax.lax.cond(changes, _look_anew, lambda carry, *_: carry, carry, closed, step)
        carry = carry._replace(waiting=carry.waiting + duration)
        found = Found(
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
    # The next step back on which something changes: a start is left, an end is met. After an end that is
    # met now, the very next one.
    change = jnp.where(together, behind.start - 1, _NEVER)
    change = jnp.where(started & (behind.end <= step), behind.end, change)
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
