"""Random numbers and choices among rows; the law of Poisson numbers is tested in `test_clutter`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxtrack import sampling
from jaxtrack.episode import sample_step_noise
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
    assert 0 < float(uniform.min()) <= float(uniform.max()) < 1
    assert abs(np.corrcoef(normal[:3000], uniform[:3000])[0, 1]) < 0.05


def test_draws_depend_on_the_key_and_on_nothing_else():
    keys = jax.random.split(jax.random.key(1), 2)
    first, again, other = (draw(key, 5, 3) for key in (keys[0], keys[0], keys[1]))
    np.testing.assert_array_equal(first[0], again[0])
    assert not np.any(first[0] == other[0])
    together = jax.vmap(lambda key: draw(key, 5, 3))(keys)
    np.testing.assert_allclose(together[1], [first[1], other[1]], rtol=1e-6)


def numbers_of_many_keys(number):
    """Numbers `[K, number]`, uniform in (0, 1), of keys that follow one another as those of an episode."""
    keys = jax.random.split(jax.random.key(4), 4000)
    return np.asarray(jax.jit(jax.vmap(lambda key: draw(key, 0, number)[1]))(keys), dtype=float)


@pytest.fixture(scope="module")
def of_many_keys():
    return numbers_of_many_keys(32)


def test_every_place_of_a_draw_is_uniform(of_many_keys):
    smallest = min(stats.kstest(column, "uniform").pvalue for column in of_many_keys.T)
    assert smallest > 0.01 / of_many_keys.shape[1]
    counts = np.bincount((of_many_keys.ravel() * 2**10).astype(int), minlength=2**10)
    assert stats.chisquare(counts).pvalue > 0.01


def bits_of(uniform, number):
    """`[..., number]` the leading bits of numbers `[...]`."""
    return (uniform[..., None] * 2.0 ** np.arange(1, number + 1)).astype(int) & 1


def test_every_bit_of_the_numbers_is_as_often_on_as_off(of_many_keys):
    share = np.mean(bits_of(of_many_keys, 23), axis=(0, 1))
    np.testing.assert_allclose(share, 0.5, atol=4.5 * 0.5 / np.sqrt(of_many_keys.size))


def test_the_places_of_a_draw_are_independent(of_many_keys):
    """Of one key: halves of a draw are worked out together. And of the next key."""
    now, following = of_many_keys[:-1], of_many_keys[1:]
    number, places_ = now.shape
    together = np.corrcoef(np.concatenate([now, following], axis=1).T)[:places_]
    together[np.eye(*together.shape, dtype=bool)] = 0
    assert np.abs(together).max() < 5 / np.sqrt(number)


def test_the_bits_of_the_halves_of_a_draw_are_independent(of_many_keys):
    """Every bit of every other: a number may be one of the other half turned round, unseen by correlation."""
    first, second = (half.reshape(-1, 23) for half in np.split(bits_of(of_many_keys, 23), 2, axis=1))
    together = np.corrcoef(first.T, second.T)[:23, 23:]
    assert np.abs(together).max() < 4.5 / np.sqrt(len(first))


def test_no_more_numbers_are_equal_than_by_chance(of_many_keys):
    """All 128,000 among one another: places, steps. Of 2^23 cells, every pair falls into one."""
    by_chance = stats.poisson(of_many_keys.size * (of_many_keys.size - 1) / 2 / 2**23)
    _, counts = np.unique(of_many_keys, return_counts=True)
    assert by_chance.cdf(np.sum(counts * (counts - 1) / 2)) < 0.999


def test_no_more_noise_is_equal_between_steps_and_environments_than_by_chance(static):
    """Keys of steps and environments as `play_episodes` takes them."""
    keys = jax.vmap(lambda key: jax.random.split(key, 50))(jax.random.split(jax.random.key(5), 40))
    noise = jax.jit(jax.vmap(jax.vmap(lambda key: sample_step_noise(key, static))))(keys)
    for name, leaf in (("motion", noise.truths.motion), ("detected", noise.sensor.detected)):
        rows = np.asarray(leaf).reshape(2000, -1)
        by_chance = stats.poisson(2000 * 1999 / 2 / 2**23)
        for place in rows.T:
            _, counts = np.unique(place, return_counts=True)
            assert by_chance.cdf(np.sum(counts * (counts - 1) / 2)) < 1 - 1e-5, name


def test_the_ends_of_the_interval_are_never_drawn():
    words = jnp.array([0, 2**31 - 1, 2**31, 2**32 - 1], dtype=jnp.uint32)
    numbers = sampling._middle_of_cell(words)
    half = 2.0**-23
    np.testing.assert_array_equal(numbers, [half, 1 - half, half - 1, -half])
    np.testing.assert_array_equal((numbers + 1) / 2, [0.5 + half / 2, 1 - half / 2, half / 2, 0.5 - half / 2])
    assert np.all(np.isfinite(jax.scipy.special.erfinv(numbers)))


def test_the_ends_of_the_interval_are_never_drawn_in_double_precision_either(x64):
    words = jnp.array([0, 2**63 - 1, 2**63, 2**64 - 1], dtype=jnp.uint64)
    numbers = sampling._middle_of_cell(words)
    assert numbers.dtype == jnp.float64
    half = 2.0**-52
    np.testing.assert_array_equal(numbers, [half, 1 - half, half - 1, -half])
    np.testing.assert_array_equal((numbers + 1) / 2, [0.5 + half / 2, 1 - half / 2, half / 2, 0.5 - half / 2])
    normal, uniform = jax.jit(draw, static_argnums=(1, 2))(jax.random.key(0), 4000, 3000)
    assert stats.kstest(normal, "norm").pvalue > 0.01
    assert stats.kstest(uniform, "uniform").pvalue > 0.01
    share = np.mean(bits_of(np.asarray(uniform), 52), axis=0)
    np.testing.assert_allclose(share, 0.5, atol=4.5 * 0.5 / np.sqrt(3000))


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
