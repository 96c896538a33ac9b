"""A platform somewhere else; `tests/parity` compares it with FixedPlatform."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack.platform import from_platform, rotation, to_platform


def test_what_lies_at_yaw_and_pitch_is_ahead(x64):
    yaw, pitch = 0.7, 0.3
    ahead = jnp.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    turned = rotation(jnp.array([0.4, pitch, yaw])) @ ahead
    np.testing.assert_allclose(turned, [1.0, 0.0, 0.0], atol=1e-15)


def test_a_platform_that_looks_north_sees_the_east_on_its_right():
    """x is east and y is north; the platform's y points to its left."""
    state = jnp.array([1010.0, 5.0, 2000.0, 0.0, 30.0, 0.0])
    seen = to_platform(state, jnp.array([10.0, 2000.0, 20.0]), jnp.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(seen, [0, 0, -1000, -5, 10, 0], atol=1e-3)


def test_a_platform_rolled_by_a_right_angle_has_the_sky_on_its_left():
    turned = rotation(jnp.array([np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(turned @ jnp.array([0.0, 0.0, 1.0]), [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(turned @ jnp.array([1.0, 2.0, 0.0]), [1, 0, -2], atol=1e-6)


def test_there_and_back(x64):
    states = jax.random.normal(jax.random.key(0), (4, 5, 6))
    place, orientation = jnp.array([3.0, -2.0, 1.0]), jnp.array([0.3, -0.8, 2.0])
    back = from_platform(to_platform(states, place, orientation), place, orientation)
    np.testing.assert_allclose(back, states, atol=1e-14)
