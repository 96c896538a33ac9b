"""The radar's platform somewhere else, or on its way: everything in jaxtrack is in the platform's frame.

Counterpart in Stone Soup: `FixedPlatform` with a position and an orientation. Truths or
trajectories given in another frame go through `to_platform` once, tracks come back through
`from_platform`; in between the platform is at the origin and looks along x.

A platform that flies straight on at a known speed (`Params.platform_speed`; Stone Soup's
`MovingPlatform`) is at the origin too, as constant velocity is the same in its frame. What changes is
that whatever is at rest in the world comes nearer: truths are born, and tracks initiated, with that
mean velocity.
"""

import jax
import jax.numpy as jnp

from jaxtrack.params import Params
from jaxtrack.types import position, velocity


def to_platform(states: jax.Array, place: jax.Array, orientation: jax.Array) -> jax.Array:
    """States `[..., 6]` (m, m/s) of the world in the platform's frame.

    Args:
        states: interleaved positions and velocities.
        place: `[3]` of the platform (m).
        orientation: `[3]` of the platform: roll, pitch, yaw (rad); Stone Soup's order and signs.
    """
    turn = rotation(orientation)
    return _interleaved((position(states) - place) @ turn.T, velocity(states) @ turn.T)


def from_platform(states: jax.Array, place: jax.Array, orientation: jax.Array) -> jax.Array:
    """Inverse of `to_platform`, with the same arguments: states of the platform's frame in the world."""
    turn = rotation(orientation)
    return _interleaved(position(states) @ turn + place, velocity(states) @ turn)


def platform_velocity(params: Params) -> jax.Array:
    """Velocity `[3]` of the platform in the world, along its own axes (m/s)."""
    return params.platform_speed * jnp.array([1.0, 0.0, 0.0])


def rotation(orientation: jax.Array) -> jax.Array:
    """Rotation `[3, 3]` from the world to a platform of orientation `[3]` roll, pitch, yaw (rad).

    ``Rx(-roll) Ry(pitch) Rz(-yaw)``: what lies at azimuth yaw and elevation pitch is ahead.
    """
    cos, sin = jnp.cos(orientation), jnp.sin(orientation)
    one, zero = jnp.ones_like(cos[0]), jnp.zeros_like(cos[0])
    roll = jnp.array([[one, zero, zero], [zero, cos[0], sin[0]], [zero, -sin[0], cos[0]]])
    pitch = jnp.array([[cos[1], zero, sin[1]], [zero, one, zero], [-sin[1], zero, cos[1]]])
    yaw = jnp.array([[cos[2], sin[2], zero], [-sin[2], cos[2], zero], [zero, zero, one]])
    return roll @ pitch @ yaw


def _interleaved(positions: jax.Array, velocities: jax.Array) -> jax.Array:
    return jnp.stack([positions, velocities], axis=-1).reshape(*positions.shape[:-1], 6)
