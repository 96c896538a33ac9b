"""The scan map against a direct computation that remembers when each pixel was last seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams, scan_map

STATIC = StaticParams(map_size=12, num_looks=5)
# Seconds rather than milliseconds, so that the map ages visibly between looks.
PARAMS = Params(time_step=0.25, scan_time_constant=0.8, beam_azimuth=0.5, beam_elevation=0.3)
update = jax.jit(scan_map.update_scan_map, static_argnums=2)
beam_weights = jax.jit(scan_map.beam_weights, static_argnums=0)


def pixel_angles():
    """Azimuth and elevation of every pixel, computed apart from the package."""
    angles = np.linspace(-PARAMS.field_limit, PARAMS.field_limit, STATIC.map_size)
    return np.meshgrid(angles, angles)


def dwell(look):
    """Pixels in the beam, by rotation matrices and arcs."""
    azimuth, elevation = pixel_angles()
    cosine = np.cos(elevation)
    points = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)], -1)
    about_z = np.array(
        [[np.cos(look[0]), np.sin(look[0]), 0], [-np.sin(look[0]), np.cos(look[0]), 0], [0, 0, 1]]
    )
    about_y = np.array(
        [[np.cos(look[1]), 0, np.sin(look[1])], [0, 1, 0], [-np.sin(look[1]), 0, np.cos(look[1])]]
    )
    x, y, z = np.moveaxis(points @ (about_y @ about_z).T, -1, 0)
    return (np.abs(np.arctan2(y, x)) <= PARAMS.beam_azimuth / 2) & (
        np.abs(np.arcsin(z)) <= PARAMS.beam_elevation / 2
    )


def test_every_pixel_follows_the_time_since_its_last_look():
    looks = np.random.default_rng(0).uniform(-PARAMS.field_limit, PARAMS.field_limit, (12, 2))
    looks[7] = looks[2]
    values = scan_map.initial_scan_map(STATIC)
    last_look = np.full((STATIC.map_size, STATIC.map_size), -np.inf)
    for step, look in enumerate(looks):
        time = step * PARAMS.time_step
        values = update(values, jnp.asarray(look), STATIC, PARAMS)
        last_look[dwell(look)] = time
        expected = 1 - np.exp(-(time - last_look) / PARAMS.scan_time_constant)
        np.testing.assert_allclose(values, expected, atol=2e-6)
    assert np.isfinite(last_look).sum() > 20


def test_a_field_never_seen_stays_at_one():
    assert bool(jnp.all(scan_map.initial_scan_map(STATIC) == 1))
    seen_nowhere = update(scan_map.initial_scan_map(STATIC), jnp.array([jnp.nan, 0.0]), STATIC, PARAMS)
    np.testing.assert_array_equal(seen_nowhere, np.ones((12, 12)))


def test_rows_are_elevations_and_columns_azimuths():
    limit = PARAMS.field_limit
    values = update(scan_map.initial_scan_map(STATIC), jnp.array([limit, -limit]), STATIC, PARAMS)
    assert float(values[0, -1]) == 0.0
    assert float(values[-1, 0]) == float(values[0, 0]) == float(values[-1, -1]) == 1.0


def test_the_outermost_pixels_lie_on_the_edge_of_the_field():
    pixels = scan_map.pixel_directions(STATIC, PARAMS)
    assert pixels.shape == (12, 12, 3)
    np.testing.assert_allclose(np.arcsin(pixels[0, 0, 2]), -PARAMS.field_limit, rtol=1e-5)
    azimuth, elevation = pixel_angles()
    np.testing.assert_allclose(np.arctan2(pixels[..., 1], pixels[..., 0]), azimuth, atol=1e-6)
    np.testing.assert_allclose(np.arcsin(pixels[..., 2]), elevation, atol=1e-6)


def test_the_grid_of_looks_counts_azimuth_first():
    grid = np.asarray(scan_map.look_grid(STATIC, PARAMS)).reshape(5, 5, 2)
    angles = np.linspace(-PARAMS.field_limit, PARAMS.field_limit, 5)
    np.testing.assert_allclose(grid[..., 0], np.repeat(angles[:, None], 5, 1), atol=1e-6)
    np.testing.assert_allclose(grid[..., 1], np.repeat(angles[None], 5, 0), atol=1e-6)


@pytest.mark.parametrize("continuous", [False, True])
def test_beam_weights_give_the_mean_scan_value_in_every_beam(continuous):
    static = StaticParams(map_size=12, num_looks=5, continuous_actions=continuous)
    weights = np.asarray(beam_weights(static, PARAMS))
    values = np.random.default_rng(1).uniform(size=(12, 12))
    angles = np.linspace(-PARAMS.field_limit, PARAMS.field_limit, 5)
    # Away from the edges of the field, where in or out is a matter of the last bit.
    inner = [(i, j) for i in range(1, 4) for j in range(1, 4)]
    for i, j in inner:
        inside = dwell((angles[i], angles[j]))
        assert inside.any()
        row = weights[5 * i + j]
        np.testing.assert_allclose(row @ values.ravel(), values[inside].mean(), rtol=1e-5)
    assert weights.shape == (25, 144)


def test_a_beam_between_the_pixels_has_no_weight():
    narrow = Params(beam_azimuth=1e-4, beam_elevation=1e-4)
    weights = beam_weights(StaticParams(map_size=2, num_looks=3), narrow)
    assert float(jnp.sum(weights[4])) == 0.0
