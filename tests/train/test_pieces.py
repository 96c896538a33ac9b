"""Gradients in pieces with short track lists are the gradients with whole ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from train.agents import build_agent
from train.config import TrainConfig
from train.loss import Sample
from train.pieces import minibatch_gradient, shortest_first

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(max_tracks=8, map_size=36, num_looks=5)
CONFIG = TrainConfig(num_envs=4, rollout_steps=4, num_minibatches=1, microbatch=4, warm_start="none")
USED = np.array([0, 1, 2, 2, 3, 4, 4, 4, 5, 8, 8, 0, 2, 6, 3, 8])
"""Slots up to the last track: lengths 4 and 8 are compiled, and all their edges are here."""


def observations():
    """Lists with empty slots between tracks, and nonsense in the empty ones."""
    rng = np.random.default_rng(0)
    mask = rng.random((len(USED), 8)) < 0.6
    mask &= np.arange(8) < USED[:, None]
    mask[np.arange(len(USED)), USED - 1] |= USED > 0
    tracks = np.where(mask[..., None], rng.uniform(size=(*mask.shape, 7)), np.nan)
    scan_map = rng.random((len(USED), 36, 36))
    return jax.tree.map(jnp.asarray, {
        "tracks": tracks.astype(np.float32), "mask": mask, "scan_map": scan_map.astype(np.float32)
    })  # fmt: skip


def minibatch(inputs):
    rng = np.random.default_rng(1)
    numbers = {name: jnp.asarray(rng.normal(size=len(USED)), float) for name in ("value", "advantage")}
    action = jnp.asarray(rng.integers(5, size=(len(USED), 2)))
    log_prob = jnp.full(len(USED), -2 * np.log(5.0))
    return Sample(inputs, action, jnp.zeros(len(USED), bool), log_prob, **numbers)


@pytest.mark.parametrize(
    ("encoder", "head"), [("bigru", "factored"), pytest.param("mhsa", "beams", marks=pytest.mark.medium)]
)
def test_short_lists_change_neither_gradients_nor_outputs(draw_variables, encoder, head):
    agent = build_agent(encoder, STATIC, Params(), head)
    inputs = jax.jit(jax.vmap(agent.features))(observations())
    weights = draw_variables(agent.network, inputs)
    lengths = []

    def cut(inputs, length):
        lengths.append(length)
        return agent.lists.cut(inputs, length)

    short = agent._replace(lists=agent.lists._replace(cut=cut))
    whole = agent._replace(lists=None)

    @jax.jit
    def outcome(weights, inputs):
        order = shortest_first(jnp.arange(len(USED)), inputs, short)
        samples, rows = minibatch(inputs), jnp.arange(len(USED))
        return (
            (
                minibatch_gradient(weights, samples, order, short, CONFIG),
                short.evaluate_quickly(weights, inputs),
            ),
            (minibatch_gradient(weights, samples, rows, whole, CONFIG), whole.evaluate(weights, inputs)),
        )

    got, expected = outcome(weights, inputs)
    assert set(lengths) == {4, 8}
    for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
        assert np.all(np.isfinite(b))
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(jnp.max(jnp.abs(b))))


def test_the_shortest_length_that_holds_all_lists_is_taken():
    agent = build_agent("bigru", STATIC, Params())
    inputs = observations()
    taken = jax.jit(lambda row: agent.on_short_lists(lambda cut: jnp.asarray(cut["mask"].shape[1]), row))
    for row, used in enumerate(USED):
        one = jax.tree.map(lambda leaf, row=row: leaf[row : row + 1], inputs)
        assert int(taken(one)) == next(length for length in (4, 8) if used <= length)


def test_samples_are_sorted_by_length_only_where_that_is_of_use():
    inputs = observations()
    rows = jnp.asarray([9, 3, 0, 5, 15])
    order = shortest_first(rows, inputs, build_agent("mhsa", STATIC, Params()))
    assert order.tolist() == [0, 3, 5, 9, 15]
    unsorted = shortest_first(rows, inputs, build_agent("flatten", STATIC, Params()))
    assert unsorted.tolist() == rows.tolist()


def test_the_size_of_a_piece_suits_the_encoder_and_divides_the_minibatch():
    free = dataclasses.replace(CONFIG, microbatch=0, num_envs=64, rollout_steps=128, num_minibatches=8)
    assert dataclasses.replace(free, encoder="beams").piece_size == 128
    assert dataclasses.replace(free, encoder="mhsa").piece_size == 64
    assert dataclasses.replace(free, encoder="mhsa", rollout_steps=10).piece_size == 16
    assert dataclasses.replace(free, microbatch=32).piece_size == 32
    assert dataclasses.replace(free, encoder="beams", devices=16).piece_size == 64
