"""The radar's platform somewhere else, or on its way: everything in jaxtrack is in the platform's frame.

Counterpart in Stone Soup: `FixedPlatform` with a position and an orientation. Truths or
trajectories given in another frame go through `to_platform` once, tracks come back through
`from_platform`; in between the platform is at the origin and looks along x.

A platform that flies straight on at a known speed (`Params.platform_speed`; Stone Soup's
`MovingPlatform`) is at the origin too, as constant velocity is the same in its frame. What changes is
that whatever is at rest in the world comes nearer: truths are born, and tracks initiated, with that
mean velocity. If it turns (`Params.platform_turn_rate`), as on a circle, the frame keeps its axes, as that of
a radar with a stabilised mount: whatever flies straight on in the world is seen to swerve, the same way for
all, and as the path is known the tracker takes it into account.
"""

import jax
import jax.numpy as jnp

from jaxtrack.models import direction, interleave, turn
from jaxtrack.params import Params
from jaxtrack.types import Scalar, position, velocity


def to_platform(states: jax.Array, place: jax.Array, orientation: jax.Array) -> jax.Array:
    """States `[..., 6]` (m, m/s) of the world in the platform's frame.

    Args:
        states: interleaved positions and velocities.
        place: `[3]` of the platform (m).
        orientation: `[3]` of the platform: roll, pitch, yaw (rad); Stone Soup's order and signs.
    """
    turned = rotation(orientation)
    return interleave((position(states) - place) @ turned.T, velocity(states) @ turned.T)


def from_platform(states: jax.Array, place: jax.Array, orientation: jax.Array) -> jax.Array:
    """Inverse of `to_platform`, with the same arguments: states of the platform's frame in the world."""
    turned = rotation(orientation)
    return interleave(position(states) @ turned + place, velocity(states) @ turned)


def platform_velocity(params: Params, step: Scalar = 0) -> jax.Array:
    """Velocity `[3]` of the platform in the world at a step, along the axes of its frame (m/s)."""
    if params.platform_turn_rate is None:
        return params.platform_speed * jnp.array([1.0, 0.0, 0.0])
    heading = jnp.asarray(params.platform_turn_rate * params.time_step * step, dtype=float)
    return params.platform_speed * direction(heading, jnp.zeros_like(heading))


def seen_in_turn(states: jax.Array, step: Scalar, params: Params) -> jax.Array:
    """States as they are seen at the end of a step from a platform that turned meanwhile.

    Args:
        states: `[..., 6]`, moved by the step as if the platform had flown straight on (m, m/s).
        step: its number.
        params: numbers.
    """
    if params.platform_turn_rate is None:
        return states
    before, after = platform_velocity(params, step - 1), platform_velocity(params, step)
    way, _ = turn(before[None], jnp.asarray(params.platform_turn_rate)[None], params.time_step)
    return states - interleave(way[0] - params.time_step * before, after - before)


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
