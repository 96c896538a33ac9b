"""Motion and measurement models: constant velocity; elevation, bearing, range.

Counterparts in Stone Soup: `CombinedLinearGaussianTransitionModel` of `ConstantVelocity`,
and `CartesianToElevationBearingRange` with its typed angles.
"""

import jax
import jax.numpy as jnp

from jaxtrack.types import Scalar, position


def constant_velocity(time_step: Scalar, process_noise: Scalar) -> tuple[jax.Array, jax.Array]:
    """Transition matrix F and process noise covariance Q of constant velocity in 3-D.

    Args:
        time_step: dt (s), scalar.
        process_noise: q, spectral density of white acceleration (m^2/s^3), scalar.

    Returns:
        F `[6, 6]` and Q `[6, 6]`, per axis ``F = [[1, dt], [0, 1]]`` and
        ``Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]``.
    """
    dt = jnp.asarray(time_step, dtype=float)
    axes = jnp.eye(3)
    F = jnp.array([[1.0, 0.0], [0.0, 1.0]]) + dt * jnp.array([[0.0, 1.0], [0.0, 0.0]])
    Q = process_noise * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return jnp.kron(axes, F), jnp.kron(axes, Q)


def wrap_bearing(angle: jax.Array) -> jax.Array:
    """Angle (rad) in [-pi, pi), as Stone Soup's `Bearing`."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) / (2 * jnp.pi))


def fold_elevation(angle: jax.Array) -> jax.Array:
    """Angle (rad) folded into [-pi/2, pi/2], as Stone Soup's `Elevation`.

    Past the zenith the elevation falls again. Differences of elevations are folded too.
    """
    wrapped = wrap_bearing(angle)
    over_the_top = jnp.abs(wrapped) > jnp.pi / 2
    return jnp.where(over_the_top, jnp.copysign(jnp.pi, wrapped) - wrapped, wrapped)


def wrap_detection(value: jax.Array) -> jax.Array:
    """Folds the elevation and wraps the bearing of `[..., 3]` detections or differences."""
    return jnp.stack([fold_elevation(value[..., 0]), wrap_bearing(value[..., 1]), value[..., 2]], axis=-1)


def elevation_bearing_range(state: jax.Array) -> jax.Array:
    """Measurement function h: states `[..., 6]` to `[..., 3]` (rad, rad, m)."""
    return spherical(position(state))


def spherical(points: jax.Array) -> jax.Array:
    """Elevation, bearing (rad) and range (m) `[..., 3]` of positions `[..., 3]` (m)."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    ground_range = jnp.sqrt(x**2 + y**2)
    return jnp.stack(
        # atan2 equals Stone Soup's arcsin(z/r) and keeps its precision near the zenith.
        [jnp.arctan2(z, ground_range), jnp.arctan2(y, x), jnp.sqrt(x**2 + y**2 + z**2)],
        axis=-1,
    )


def spherical_offsets(centre: jax.Array, displacement: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Change of elevation, bearing and range from `centre` to ``centre + displacement``.

    Taken from cross and dot products, so that nothing cancels in float32 and no angle is
    computed twice.

    Args:
        centre: `[3]` position (m).
        displacement: `[..., 3]` (m).

    Returns:
        Sines `[..., 2]` and cosines `[..., 2]` of the changes of elevation and bearing, and
        the changes of range `[...]` (m).
    """
    x, y, z = centre[0], centre[1], centre[2]
    dx, dy, dz = displacement[..., 0], displacement[..., 1], displacement[..., 2]
    ground = jnp.sqrt((x + dx) ** 2 + (y + dy) ** 2)
    slant = jnp.sqrt(ground**2 + (z + dz) ** 2)
    ground_centre = jnp.sqrt(x**2 + y**2)
    slant_centre = jnp.sqrt(ground_centre**2 + z**2)
    ground_square_change = (2 * x + dx) * dx + (2 * y + dy) * dy
    ground_change = ground_square_change / (ground + ground_centre)
    range_change = (ground_square_change + (2 * z + dz) * dz) / (slant + slant_centre)
    slants, grounds = slant * slant_centre, ground * ground_centre
    sine = jnp.stack(
        [(dz * ground_centre - z * ground_change) / slants, (x * dy - y * dx) / grounds], axis=-1
    )
    cosine = jnp.stack([(grounds + (z + dz) * z) / slants, (x * (x + dx) + y * (y + dy)) / grounds], axis=-1)
    return sine, cosine, range_change


def direction(azimuth: jax.Array, elevation: jax.Array) -> jax.Array:
    """Unit vectors `[..., 3]` towards azimuth and elevation (rad) of equal shapes."""
    return jnp.stack(
        [
            jnp.cos(elevation) * jnp.cos(azimuth),
            jnp.cos(elevation) * jnp.sin(azimuth),
            jnp.sin(elevation),
        ],
        axis=-1,
    )


def inverse_elevation_bearing_range(detection: jax.Array) -> jax.Array:
    """Position `[..., 3]` (m) of detections `[..., 3]`: Stone Soup's `inverse_function`."""
    return detection[..., 2:3] * direction(detection[..., 1], detection[..., 0])


def inverse_jacobian(detection: jax.Array) -> jax.Array:
    """Derivative `[3, 3]` of the position by (elevation, bearing, range) at one detection `[3]`.

    The inverse of h's Jacobian at that position. Stone Soup takes the latter by finite
    differences, which is only good to about 1e-5.
    """
    return jax.jacfwd(inverse_elevation_bearing_range)(detection)
