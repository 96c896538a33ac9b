"""Random numbers and choices among rows; the law of Poisson numbers is tested in `test_clutter`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxtrack.sampling import draw, draw_index, first_largest, matches, places, poisson_quantile, split


@pytest.mark.parametrize("largest", [0, 1, 5])
def test_no_number_exceeds_the_largest_and_that_one_can_come(largest):
    assert int(poisson_quantile(jnp.asarray(0.999), 30.0, largest)) == largest


def test_draws_follow_their_laws_and_are_independent():
    normal, uniform = jax.jit(draw, static_argnums=(1, 2))(jax.random.key(0), 4000, 3001)
    assert normal.shape == (4000,)
    assert uniform.shape == (3001,)
    assert stats.kstest(normal, "norm").pvalue > 0.01
    assert stats.kstest(uniform, "uniform").pvalue > 0.01
    assert 0 <= float(uniform.min()) <= float(uniform.max()) < 1
    assert abs(np.corrcoef(normal[:3000], uniform[:3000])[0, 1]) < 0.05


def test_draws_depend_on_the_key_and_on_nothing_else():
    keys = jax.random.split(jax.random.key(1), 2)
    first, again, other = (draw(key, 5, 3) for key in (keys[0], keys[0], keys[1]))
    np.testing.assert_array_equal(first[0], again[0])
    assert not np.any(first[0] == other[0])
    together = jax.vmap(lambda key: draw(key, 5, 3))(keys)
    np.testing.assert_allclose(together[1], [first[1], other[1]], rtol=1e-6)


def test_draws_have_the_precision_asked_for(x64):
    assert [numbers.dtype for numbers in draw(jax.random.key(0), 2, 2)] == [jnp.float64] * 2


def test_a_split_is_that_of_jax_also_of_many_keys():
    keys = jax.random.split(jax.random.key(2), 3)
    first, second = jax.jit(jax.vmap(split))(keys)
    expected = jax.vmap(jax.random.split)(keys)
    assert jnp.all(first == expected[:, 0])
    assert jnp.all(second == expected[:, 1])


def test_an_index_is_uniform_and_another_one_at_every_time():
    drawn = jax.jit(jax.vmap(lambda time: draw_index(jax.random.key(3), time, 5)))(jnp.arange(4000))
    counts = np.bincount(drawn, minlength=5)
    assert len(counts) == 5
    assert stats.chisquare(counts).pvalue > 0.01


@pytest.mark.parametrize(
    ("values", "expected"),
    [([1, 3, 2], 1), ([2, 5, 5], 1), ([-np.inf, -np.inf], 0), ([-4.0], 0), ([0.0, -0.0, np.inf], 2)],
)
def test_the_first_of_the_largest(values, expected):
    assert int(first_largest(jnp.asarray(values, dtype=float))) == expected


def test_a_nan_still_gives_a_row():
    assert int(first_largest(jnp.array([1.0, jnp.nan, 3.0]))) == 0


def test_places_count_the_chosen_before():
    chosen = jnp.array([False, True, True, False, True])
    np.testing.assert_array_equal(places(chosen), [0, 0, 1, 2, 2])


@pytest.mark.parametrize("seed", range(5))
def test_the_kth_taker_gets_the_kth_row(seed):
    rng = np.random.default_rng(seed)
    takers, taken = rng.random(9) < 0.5, rng.random(6) < 0.5
    gets, which = matches(jnp.asarray(takers), jnp.asarray(taken))
    pairs = list(zip(np.flatnonzero(takers), np.flatnonzero(taken), strict=False))
    assert [(row, int(which[row])) for row in np.flatnonzero(gets)] == pairs
