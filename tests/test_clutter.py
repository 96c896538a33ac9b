"""False detections: how many, and where."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxtrack import Params, StaticParams, sensor

STATIC = StaticParams(max_clutter=8)


@jax.jit
def count(uniform, params):
    """Numbers of false detections and excesses for many draws."""
    return jax.vmap(lambda u: sensor.clutter_count(u, STATIC, params))(uniform)


@pytest.mark.parametrize("rate", [0.1, 1.0, 2.5, 8.0])
def test_one_uniform_draw_becomes_the_poisson_quantile(rate):
    uniform = np.linspace(0.0013, 0.9993, 500)
    number, excess = count(jnp.asarray(uniform), Params(clutter_rate=rate))
    np.testing.assert_array_equal(number + excess, stats.poisson.ppf(uniform, rate))
    assert int(jnp.max(number)) <= STATIC.max_clutter
    assert np.all((np.asarray(excess) == 0) | (np.asarray(number) == STATIC.max_clutter))


def test_many_draws_have_mean_and_variance_of_the_rate():
    uniform = jax.random.uniform(jax.random.key(0), (20_000,))
    number, excess = count(uniform, Params(clutter_rate=3.0))
    total = np.asarray(number + excess)
    # Five standard errors: sqrt(3/n) of the mean, sqrt((3 + 2 * 9)/n) of the variance.
    assert abs(total.mean() - 3) < 5 * np.sqrt(3 / total.size)
    assert abs(total.var() - 3) < 5 * np.sqrt(21 / total.size)


def test_rate_zero_gives_none_even_for_the_largest_draw():
    uniform = jnp.array([0.0, 0.5, np.nextafter(np.float32(1), np.float32(0)), 1.0])
    number, excess = count(uniform, Params(clutter_rate=0.0))
    np.testing.assert_array_equal(number, [0] * 4)
    np.testing.assert_array_equal(excess, [0] * 4)


def test_without_clutter_slots_there_is_no_clutter():
    number, excess = sensor.clutter_count(0.9, StaticParams(max_clutter=0), Params())
    assert (int(number), int(excess)) == (0, 0)


@jax.jit
def scatter(uniform, look, params):
    points = sensor.clutter_points(uniform, look, params)
    return sensor.boresight_frame(points, look), sensor.in_beam(points, look, params)


def test_false_detections_fill_the_beam_evenly(params):
    look = jnp.array([0.6, -0.8])
    uniform = jax.random.uniform(jax.random.key(1), (3000, 3))
    turned, inside = scatter(uniform, look, params)
    turned = np.asarray(turned)
    distance = np.linalg.norm(turned, axis=-1)
    shares = [
        np.arctan2(turned[:, 1], turned[:, 0]) / params.beam_azimuth + 0.5,
        np.arcsin(turned[:, 2] / distance) / params.beam_elevation + 0.5,
        (distance - params.min_range) / (params.max_range - params.min_range),
    ]
    for share in shares:
        assert np.all((share > -1e-4) & (share < 1 + 1e-4))
        assert stats.kstest(share, "uniform").pvalue > 1e-3
    assert np.mean(inside) > 0.999
    np.testing.assert_allclose(np.corrcoef(shares), np.eye(3), atol=0.1)
