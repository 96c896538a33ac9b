"""A plan for searching a field that was never seen: which looks, in which order.

Beams overlap by parts of a pixel, and every look decides what those after it still find, so the look
that finds most on the scan map is not the best one. The plan is made beforehand, on a finer map.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.beam_means import beam_means
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import first_largest
from jaxtrack.scan_map import beam_sizes, initial_scan_map, look_grid, pixels_in_beam

FINENESS = 3
"""Pixels of the plan's map along one pixel of the scan map."""

WAITING_SHARE = 0.05
"""A planned look waits for its turn while more than this part of what it is to find is unseen."""

AHEAD = 1.001
"""The worth of the next look, per largest worth: ahead of all others, but by little."""


class SearchPlan(struct.PyTreeNode):
    """Every look's place in the plan.

    Attributes:
        turn: `[K]` place in the order, from 0; K if the look is not in the plan.
        share: `[K]` part of its beam that nobody looked at before its turn; 0 if it is not in the plan.
    """

    turn: jax.Array  # [K] int
    share: jax.Array  # [K]

    def next_look(self, unseen: jax.Array) -> jax.Array:
        """`[K]` true at the first look of the plan that still waits; nowhere if none does.

        Args:
            unseen: `[K]` part of each look's beam that was never seen, or long ago.
        """
        none = self.turn.size
        turns = jnp.where(unseen > WAITING_SHARE * self.share, self.turn, none)
        return (turns == jnp.min(turns)) & (turns < none)

    def prefer_next(self, worth: jax.Array, unseen: jax.Array) -> jax.Array:
        """Worths `[K]` of searching, in which the plan's next look is worth as much as the best."""
        return jnp.where(self.next_look(unseen), AHEAD * jnp.max(worth), worth)


Carry = tuple[jax.Array, SearchPlan]
"""What nobody looked at so far, `[M, M]`, and the plan so far."""


def search_plan(static: StaticParams, params: Params) -> SearchPlan:
    """Each look in turn is the one that finds most of the field unseen (greedy maximum coverage)."""
    fine = dataclasses.replace(static, map_size=FINENESS * static.map_size)
    looks, sizes, means = look_grid(static, params), beam_sizes(fine, params), beam_means(fine, params)
    number = looks.shape[0]

    def take(
        carry: tuple[jax.Array, SearchPlan], turn: jax.Array
    ) -> tuple[tuple[jax.Array, SearchPlan], None]:
        unseen, plan = carry
        shares = means(unseen)
        best = first_largest(sizes * shares)
        # Rounding leaves nothing that is not a whole pixel.
        finds = sizes[best] * shares[best] > 0.5
        chosen = (jnp.arange(number) == best) & finds
        plan = SearchPlan(
            turn=jnp.where(chosen, turn, plan.turn), share=jnp.where(chosen, shares[best], plan.share)
        )
        return (jnp.where(pixels_in_beam(looks[best], fine, params), 0.0, unseen), plan), None

    empty = SearchPlan(turn=jnp.full(number, number), share=jnp.zeros(number))
    (_, plan), _ = jax.lax.scan(take, (initial_scan_map(fine), empty), jnp.arange(number))
    return plan
