"""Spaces: what they sample and what they contain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import make
from jaxtrack.spaces import Box, Dict, Indices

KEYS = jax.random.split(jax.random.key(0), 500)


def test_indices_are_sampled_from_the_first_to_the_last():
    space = Indices(3, (2,))
    samples = np.asarray(jax.vmap(space.sample)(KEYS))
    assert samples.shape == (500, 2)
    assert samples.dtype == np.int32
    for column in samples.T:
        counts = np.bincount(column, minlength=3)
        # 500 draws of probability 1/3: mean 167, five standard deviations are 53.
        assert counts.shape == (3,)
        assert np.all(np.abs(counts - 500 / 3) < 53)
    assert bool(jnp.all(jax.vmap(space.contains)(samples)))


@pytest.mark.parametrize(
    ("action", "inside"), [([0, 2], True), ([3, 0], False), ([0, -1], False), ([1, 1], True)]
)
def test_indices_contain_what_lies_below_the_count(action, inside):
    assert bool(Indices(3, (2,)).contains(jnp.array(action))) == inside


GOOD = {"a": jnp.array([0.0, 1.0]), "b": jnp.array(0.5)}


@pytest.mark.parametrize(
    ("value", "inside"),
    [
        (GOOD, True),
        ({"a": GOOD["a"]}, False),
        (GOOD | {"c": GOOD["b"]}, False),
        (GOOD | {"a": jnp.array([0.0, 1.1])}, False),
        (GOOD | {"b": jnp.array(-0.1)}, False),
        (GOOD | {"b": jnp.array(jnp.nan)}, False),
        (GOOD | {"a": jnp.zeros(3)}, False),
    ],
)
def test_a_dictionary_needs_its_keys_shapes_and_ranges(value, inside):
    space = Dict({"a": Box(0.0, 1.0, (2,)), "b": Box(0.0, 1.0, ())})
    assert bool(space.contains(value)) == inside
    assert bool(jax.jit(space.contains)(value)) == inside


@pytest.mark.parametrize(
    ("action", "inside"), [([0.0, 1.0], False), ([0, 1, 2], False), ([2, 2], True), ([[0, 1]], False)]
)
def test_indices_contain_integers_of_their_shape_only(action, inside):
    assert bool(Indices(3, (2,)).contains(jnp.array(action))) == inside


def test_a_sample_of_the_observation_space_lies_in_it():
    env, params = make()
    space = env.observation_space(params)
    sample = jax.jit(space.sample)(jax.random.key(0))
    assert bool(space.contains(sample))
    assert bool(jnp.all(jnp.isfinite(sample["tracks"])))
    assert set(np.unique(sample["mask"])) == {False, True}
