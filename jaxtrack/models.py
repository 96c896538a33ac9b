"""Motion and measurement models: constant velocity; elevation, bearing, range.

Counterparts in Stone Soup: `CombinedLinearGaussianTransitionModel` of `ConstantVelocity`,
and `CartesianToElevationBearingRange` with its typed angles.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxtrack.params import Params
from jaxtrack.types import STATE_DIM, Scalar, position


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


def turn(velocities: jax.Array, rates: jax.Array, time_step: Scalar) -> tuple[jax.Array, jax.Array]:
    """A coordinated turn about the vertical: way `[N, 3]` (m) and velocities after one time step.

    Counterpart in Stone Soup: `KnownTurnRate` in x and y, constant velocity in z.

    Args:
        velocities: `[N, 3]` (m/s).
        rates: `[N]`, positive to the left (rad/s).
        time_step: (s).
    """
    angle = rates * time_step
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    ahead = jnp.sinc(angle / jnp.pi)  # sin(angle) / angle, also at 0
    aside = jnp.sinc(angle / (2 * jnp.pi)) * jnp.sin(angle / 2)  # (1 - cos(angle)) / angle
    x, y, z = jnp.moveaxis(velocities, -1, 0)
    way = time_step * jnp.stack([ahead * x - aside * y, aside * x + ahead * y, z], axis=-1)
    return way, jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def arctan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """Angle (rad) of ``(x, y)``, elementwise, of arrays of one shape: within 2 units in the last place.

    In float32 by a polynomial (Cephes' `atanf`), which a CPU works out for many elements at
    once; the library's function goes one by one. In float64 the library's.
    """
    if y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    shape, y, x = y.shape, y.ravel(), x.ravel()
    short, long = jnp.minimum(jnp.abs(x), jnp.abs(y)), jnp.maximum(jnp.abs(x), jnp.abs(y))
    # Beyond pi/8 the angle is taken from pi/4.
    beyond = short > math.tan(math.pi / 8) * long
    numerator = jnp.where(beyond, short - long, short)
    denominator = jnp.where(beyond, short + long, long)
    slope = numerator / jnp.where(denominator == 0, 1.0, denominator)
    square = slope * slope
    series = jnp.full_like(square, 8.05374449538e-2)
    for coefficient in (-1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1):
        series = series * square + coefficient
    angle = slope + slope * square * series
    angle = jnp.where(beyond, math.pi / 4 + angle, angle)
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.copysign(angle, y).reshape(shape)


def less_sine(angle: jax.Array) -> jax.Array:
    """``angle - sin(angle)`` (rad), elementwise, to full precision also where nearly all of it cancels."""
    square = angle**2
    series = jnp.ones_like(angle)
    for n in (12, 10, 8, 6, 4):  # below 0.5 rad no more terms are felt
        series = 1 - square / (n * (n + 1)) * series
    return jnp.where(jnp.abs(angle) < 0.5, angle * square / 6 * series, angle - jnp.sin(angle))


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


def wrap_detection(value: jax.Array, axis: int = -1) -> jax.Array:
    """Folds the elevation and wraps the bearing of detections or differences, 3 along `axis`."""
    elevation, bearing, distance = jnp.moveaxis(value, axis, 0)
    return jnp.stack([fold_elevation(elevation), wrap_bearing(bearing), distance], axis=axis)


def elevation_bearing_range(state: jax.Array) -> jax.Array:
    """Measurement function h: states `[..., 6]` to `[..., 3]` (rad, rad, m)."""
    return spherical(position(state))


def spherical(points: jax.Array, axis: int = -1) -> jax.Array:
    """Elevation, bearing (rad) and range (m) of positions (m), 3 along `axis` of both."""
    x, y, z = jnp.moveaxis(points, axis, 0)
    ground_range = jnp.sqrt(x**2 + y**2)
    # atan2 equals Stone Soup's arcsin(z/r) and keeps its precision near the zenith.
    elevation, bearing = arctan2(jnp.stack([z, y]), jnp.stack([ground_range, x]))
    return jnp.stack([elevation, bearing, jnp.sqrt(x**2 + y**2 + z**2)], axis=axis)


def spherical_offsets(
    centre: Sequence[jax.Array], displacement: Sequence[jax.Array]
) -> tuple[jax.Array, ...]:
    """Change of elevation, bearing and range from `centre` to ``centre + displacement``.

    Taken from cross and dot products, so that nothing cancels in float32 and no angle is
    computed twice.

    Args:
        centre: x, y, z of positions, three arrays of one shape (m).
        displacement: the same of displacements (m).

    Returns:
        Sine and cosine of the change of elevation, sine and cosine of the change of bearing,
        and the change of range (m), five arrays.
    """
    x, y, z = centre
    dx, dy, dz = displacement
    ground = jnp.sqrt((x + dx) ** 2 + (y + dy) ** 2)
    slant = jnp.sqrt(ground**2 + (z + dz) ** 2)
    ground_centre = jnp.sqrt(x**2 + y**2)
    slant_centre = jnp.sqrt(ground_centre**2 + z**2)
    ground_square_change = (2 * x + dx) * dx + (2 * y + dy) * dy
    ground_change = ground_square_change / (ground + ground_centre)
    range_change = (ground_square_change + (2 * z + dz) * dz) / (slant + slant_centre)
    slants, grounds = slant * slant_centre, ground * ground_centre
    return (
        (dz * ground_centre - z * ground_change) / slants,
        (grounds + (z + dz) * z) / slants,
        (x * dy - y * dx) / grounds,
        (x * (x + dx) + y * (y + dy)) / grounds,
        range_change,
    )


def interleave(positions: jax.Array, velocities: jax.Array) -> jax.Array:
    """States `[..., 6]` of positions `[..., 3]` (m) and velocities `[..., 3]` (m/s)."""
    return jnp.stack([positions, velocities], axis=-1).reshape(*positions.shape[:-1], STATE_DIM)


def interleave_blocks(pp: jax.Array, pv: jax.Array, vp: jax.Array, vv: jax.Array) -> jax.Array:
    """Matrices `[..., 6, 6]` of their blocks `[..., 3, 3]` of positions p and velocities v."""
    upper, lower = jnp.stack([pp, pv], axis=-1), jnp.stack([vp, vv], axis=-1)
    return jnp.stack([upper, lower], axis=-3).reshape(*pp.shape[:-2], STATE_DIM, STATE_DIM)


def measurement_sigmas(params: Params) -> jax.Array:
    """Standard deviations `[3]` of measured elevation, bearing (rad) and range (m)."""
    return jnp.array([params.elevation_sigma, params.bearing_sigma, params.range_sigma], dtype=float)


def measurement_noise(params: Params) -> jax.Array:
    """Measurement noise covariance R `[3, 3]` (rad^2, rad^2, m^2)."""
    return jnp.diag(measurement_sigmas(params) ** 2)


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


def position_jacobian(points: jax.Array) -> jax.Array:
    """Derivative `[..., 3, 3]` of (elevation, bearing, range) by the position at `points` `[..., 3]` (m).

    Exact. Stone Soup's `CartesianToElevationBearingRange.jacobian` takes finite differences.
    """
    x, y, z = jnp.moveaxis(points, -1, 0)
    ground = jnp.sqrt(x**2 + y**2)
    slant = jnp.sqrt(x**2 + y**2 + z**2)
    by_elevation = [-x * z / (ground * slant**2), -y * z / (ground * slant**2), ground / slant**2]
    by_bearing = [-y / ground**2, x / ground**2, jnp.zeros_like(x)]
    rows = [by_elevation, by_bearing, [x / slant, y / slant, z / slant]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def inverse_jacobian(detection: jax.Array) -> jax.Array:
    """Derivative `[..., 3, 3]` of the position by (elevation, bearing, range) at detections `[..., 3]`.

    The inverse of h's Jacobian at that position. Stone Soup takes the latter by finite
    differences, which is only good to about 1e-5.
    """
    elevation, bearing, distance = jnp.moveaxis(detection, -1, 0)
    ahead, above = direction(bearing, elevation), direction(bearing, elevation + jnp.pi / 2)
    aside = jnp.stack([-ahead[..., 1], ahead[..., 0], jnp.zeros_like(distance)], axis=-1)
    return jnp.stack([distance[..., None] * above, distance[..., None] * aside, ahead], axis=-1)
