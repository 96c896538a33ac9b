"""The search plan against plain numpy, and what it is worth on a field that was never seen."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.beam_means import beam_means
from jaxtrack.models import direction
from jaxtrack.scan_map import (
    beam_sizes,
    initial_scan_map,
    look_grid,
    pixel_directions,
    update_scan_map,
)
from jaxtrack.search_plan import FINENESS, SearchPlan, search_plan
from jaxtrack.sensor import in_beam

STATIC = StaticParams(map_size=9, num_looks=5)
# Beams overlap: looks lie 30 degrees apart, a beam reaches 20 degrees to each side.
PARAMS = Params(beam_azimuth=0.7, beam_elevation=0.7)


def covered(points, static, params):
    """`[K, P]` which points each look's beam holds."""
    held = jax.jit(jax.vmap(in_beam, in_axes=(None, 0, None)))
    return np.asarray(held(points, look_grid(static, params), params))


@pytest.fixture(scope="module")
def plan():
    """The plan of the small scenario."""
    return jax.device_get(jax.jit(search_plan, static_argnums=0)(STATIC, PARAMS))


def test_each_look_in_turn_finds_most(plan):
    fine = dataclasses.replace(STATIC, map_size=FINENESS * STATIC.map_size)
    held = covered(pixel_directions(fine, PARAMS).reshape(-1, 3), STATIC, PARAMS)
    unseen = held.any(axis=0)
    order = np.argsort(plan.turn, kind="stable")[: np.sum(plan.share > 0)]
    assert plan.turn[order].tolist() == list(range(len(order)))
    for look in order:
        finds = (held & unseen).sum(axis=1)
        assert finds[look] == finds.max()
        np.testing.assert_allclose(plan.share[look], finds[look] / held[look].sum(), rtol=1e-5)
        unseen &= ~held[look]
    assert not unseen.any()
    left_out = np.setdiff1d(np.arange(25), order)
    assert (plan.turn[left_out] == 25).all()
    assert (plan.share[left_out] == 0).all()


BY_HAND = SearchPlan(turn=jnp.array([2, 0, 4, 1]), share=jnp.array([0.5, 1.0, 0.0, 0.8]))


@pytest.mark.parametrize(
    ("unseen", "following"),
    [
        ([1, 1, 1, 1], 1),  # the first in the order
        ([1, 0, 1, 1], 3),
        ([1, 0, 1, 0.039], 0),  # less than a twentieth of what it was to find is left
        ([1, 0, 1, 0.041], 3),
        ([0, 0, 1, 0], None),  # look 2 is not in the plan
        ([0, 0.9, 0, 0], 1),  # long ago counts again
    ],
)
def test_the_next_look_is_the_first_that_waits(unseen, following):
    chosen = BY_HAND.next_look(jnp.array(unseen))
    assert np.flatnonzero(chosen).tolist() == ([] if following is None else [following])


def test_the_next_look_is_worth_more_than_the_best_and_the_others_keep_their_worth():
    worth = jnp.array([0.3, 0.1, 0.7, 0.2])
    raised = BY_HAND.prefer_next(worth, jnp.ones(4))
    np.testing.assert_allclose(raised, [0.3, 0.7, 0.7, 0.2], rtol=2e-3)
    assert jnp.argmax(raised) == 1
    np.testing.assert_array_equal(BY_HAND.prefer_next(worth, jnp.zeros(4)), worth)


def test_the_plan_finds_directions_earlier_than_the_largest_finds_do():
    """In the paper's scenario, without tracks: mean time until a direction is first looked at."""
    static, params = StaticParams(), Params()
    angles = np.random.default_rng(0).uniform(-params.field_limit, params.field_limit, (2, 5000))
    held = covered(direction(*jnp.asarray(angles, dtype=float)), static, params)
    looks, steps = look_grid(static, params), 400

    def order_of(worth):
        def look(scan_map, _):
            best = jnp.argmax(worth(scan_map))
            return update_scan_map(scan_map, looks[best], static, params), best

        _, order = jax.lax.scan(look, initial_scan_map(static), length=steps)
        return order

    @jax.jit
    def orders(params):
        means, plan = beam_means(static, params), search_plan(static, params)
        roots = jnp.sqrt(beam_sizes(static, params))

        def planned(scan_map):
            unseen = means(scan_map**16)
            return plan.prefer_next(roots * unseen, unseen)

        return order_of(lambda scan_map: roots * means(scan_map**16)), order_of(planned)

    def seconds(order):
        first = np.argmax(held[np.asarray(order)], axis=0)
        seen = held[np.asarray(order)].any(axis=0)
        return params.time_step * np.where(seen, first + 1, steps).mean()

    without, planned = map(seconds, orders(params))
    assert planned < 0.47
    assert planned < 0.97 * without
