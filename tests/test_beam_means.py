import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack.beam_means import beam_means, beam_pixels
from jaxtrack.params import Params, StaticParams
from jaxtrack.scan_map import beam_weights

STATIC = StaticParams(map_size=24, num_looks=5)
NARROW, WIDE = Params(), Params(beam_elevation=np.radians(40.0))
MAPS = np.random.default_rng(2).uniform(size=(3, 2, 24, 24)).astype(np.float32)


def expected(params):
    weights = np.asarray(jax.jit(beam_weights, static_argnums=0)(STATIC, params))
    return MAPS.reshape(3, 2, -1) @ weights.T


def means(params):
    return beam_means(STATIC, params)


@pytest.mark.parametrize("params", [NARROW, WIDE], ids=["narrow", "wide"])
def test_they_are_the_weights_times_the_map_however_many_maps(params):
    """Narrow beams by the pixels they hold, wide ones by all."""
    assert bool(jax.jit(beam_pixels, static_argnums=0)(STATIC, params).small) == (params is NARROW)
    one = jax.jit(lambda maps, params: means(params)(maps))(MAPS[0, 0], params)
    many = jax.jit(lambda maps, params: jax.vmap(means(params))(maps))(MAPS[:, 0], params)
    twice = jax.jit(lambda maps, params: jax.vmap(jax.vmap(means(params)))(maps))(MAPS, params)
    last = jax.jit(lambda maps, params: jax.vmap(means(params), in_axes=2)(maps))(
        np.moveaxis(MAPS[:, 1], 0, 2), params
    )
    np.testing.assert_allclose(one, expected(params)[0, 0], rtol=1e-5)
    np.testing.assert_allclose(many, expected(params)[:, 0], rtol=1e-5)
    np.testing.assert_allclose(twice, expected(params), rtol=1e-5)
    np.testing.assert_allclose(last, expected(params)[:, 1], rtol=1e-5)


def test_every_map_with_a_beam_of_its_own():
    def of_width(scan_map, width):
        return means(Params(beam_azimuth=width))(scan_map)

    widths = np.radians([5.0, 9.0, 60.0])
    found = jax.jit(jax.vmap(of_width))(MAPS[:, 0], jnp.asarray(widths, jnp.float32))
    for row, width, all_means in zip(range(3), widths, found, strict=True):
        np.testing.assert_allclose(
            all_means, expected(Params(beam_azimuth=np.float32(width)))[row, 0], rtol=1e-5
        )


def test_in_the_papers_scenario_all_beams_are_small():
    pixels = jax.jit(beam_pixels, static_argnums=0)(StaticParams(), Params())
    assert bool(pixels.small)
    assert pixels.pixel.shape == (361, 24)
    np.testing.assert_allclose(pixels.weight.sum(axis=1), 1.0, rtol=1e-6)
