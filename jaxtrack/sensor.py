"""The steerable radar: where it looks, what its beam holds, what it detects.

Counterpart in Stone Soup: `RadarRotatingElevationBearingRange`. Its field of view is tested
in the boresight frame, edges included; detections are given in the platform frame.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.kernel import stage
from jaxtrack.models import direction, measurement_sigmas, spherical, wrap_detection
from jaxtrack.params import Params, StaticParams
from jaxtrack.sampling import matches, poisson_quantile
from jaxtrack.types import NO_TRUTH, Detections, Truths, position


class SensorNoise(struct.PyTreeNode):
    """The random draws of one look.

    Attributes:
        detection: `[N, 3]` standard normal, scaled by the measurement sigmas.
        detected: `[N]` uniform in [0, 1), below the detection probability is detected.
        clutter_count: `[]` uniform, turned into a Poisson number.
        clutter: `[C, 3]` uniform places of false detections in the beam.
    """

    detection: jax.Array  # [N, 3]
    detected: jax.Array  # [N]
    clutter_count: jax.Array  # []
    clutter: jax.Array  # [C, 3]


def num_draws(static: StaticParams) -> tuple[int, int]:
    """Standard normal and uniform numbers that one look takes."""
    return 3 * static.num_truths, static.num_truths + 1 + 3 * static.max_clutter


def cut_noise(normal: jax.Array, uniform: jax.Array, static: StaticParams) -> SensorNoise:
    """The noise of one look from as many numbers as `num_draws` says."""
    n = static.num_truths
    return SensorNoise(
        detection=normal.reshape(n, 3),
        detected=uniform[:n],
        clutter_count=uniform[n],
        clutter=uniform[n + 1 :].reshape(static.max_clutter, 3),
    )


def look_angles(action: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Boresight `[..., 2]` (azimuth, elevation in rad) of an action (paper, eq. 2).

    Discrete actions are two indices, ``angle = limit (2 a / (N_a - 1) - 1)``; continuous ones
    are the angles themselves. Values outside the field are moved to its edge; a NaN angle
    looks nowhere.
    """
    if static.continuous_actions:
        return jnp.clip(jnp.asarray(action, dtype=float), -params.field_limit, params.field_limit)
    last = static.num_looks - 1
    index = jnp.clip(action, 0, last)
    return params.field_limit * (2 * index / last - 1)


def look_indices(angles: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Indices `[..., 2]` of the discrete look nearest to angles `[..., 2]` (azimuth, elevation in rad)."""
    last = static.num_looks - 1
    return jnp.clip(jnp.round((angles / params.field_limit + 1) / 2 * last), 0, last).astype(int)


def look_number(angles: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Number ``i L + j`` of the discrete look (i, j) nearest to angles `[2]` (azimuth, elevation in rad)."""
    azimuth, elevation = look_indices(angles, static, params)
    return azimuth * static.num_looks + elevation


def boresight_frame(points: jax.Array, look: jax.Array) -> jax.Array:
    """Points `[..., 3]` turned so that the look `[2]` lies along x."""
    return _turn(points, _cosines_and_sines(look))


def _cosines_and_sines(look: jax.Array) -> tuple[jax.Array, ...]:
    """Of azimuth, then of elevation of a look `[2, ...]`."""
    return jnp.cos(look[0]), jnp.sin(look[0]), jnp.cos(look[1]), jnp.sin(look[1])


def _turn(points: jax.Array, cosines_and_sines: tuple[jax.Array, ...]) -> jax.Array:
    cos_az, sin_az, cos_el, sin_el = cosines_and_sines
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    forward = cos_az * x + sin_az * y
    return jnp.stack(
        [
            cos_el * forward + sin_el * z,
            cos_az * y - sin_az * x,
            cos_el * z - sin_el * forward,
        ],
        axis=-1,
    )


def platform_frame(points: jax.Array, look: jax.Array) -> jax.Array:
    """Inverse of `boresight_frame`."""
    cos_az, sin_az, cos_el, sin_el = _cosines_and_sines(look)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    forward = cos_el * x - sin_el * z
    return jnp.stack(
        [cos_az * forward - sin_az * y, sin_az * forward + cos_az * y, cos_el * z + sin_el * x],
        axis=-1,
    )


def in_beam(points: jax.Array, look: jax.Array, params: Params) -> jax.Array:
    """`[...]` whether points `[..., 3]` lie in the beam of a look `[2]`, edges included.

    Boresight bearing and elevation within half the beam's widths; written without arcs:
    ``|y| <= tan(b/2) x`` and ``|z| <= sin(e/2) r``.
    """
    return _ahead(boresight_frame(points, look), params)


def _ahead(turned: jax.Array, params: Params) -> jax.Array:
    """`in_beam` of points `[..., 3]` in the boresight frame."""
    x, y, z = turned[..., 0], turned[..., 1], turned[..., 2]
    half_bearing, half_elevation = params.beam_azimuth / 2, params.beam_elevation / 2
    in_bearing = jnp.abs(y) * jnp.cos(half_bearing) <= jnp.sin(half_bearing) * x
    radius_squared = x**2 + y**2 + z**2
    in_elevation = z**2 <= jnp.sin(half_elevation) ** 2 * radius_squared
    return in_bearing & in_elevation


def in_beams(points: jax.Array, looks: jax.Array, params: Params) -> jax.Array:
    """`[T, A]` whether points `[T, 3]` lie in the beams of looks `[A, 2]`."""
    # The looks come last: a CPU works on several numbers at a time only along long rows.
    return in_beams_of(points[:, None], frames(looks), params)


def frames(looks: jax.Array) -> tuple[jax.Array, ...]:
    """What is known of looks `[A, 2]` whatever the point: worked out once, not again for every point."""
    return stage(_cosines_and_sines)(looks.T)


def in_beams_of(points: jax.Array, of_looks: tuple[jax.Array, ...], params: Params) -> jax.Array:
    """`[..., A]` whether points `[..., 3]`, or `[..., 1, 3]`, lie in the beams of A looks, given `frames`."""
    return _ahead(_turn(points, of_looks), params)


def detect(
    truths: Truths, look: jax.Array, noise: SensorNoise, static: StaticParams, params: Params
) -> tuple[Detections, jax.Array]:
    """What a look `[2]` (rad) returns: truths in the beam, then clutter, in order.

    Returns:
        The detections, and how many found no slot or exceeded `max_clutter`.
    """
    seen = truths.alive & in_beam(position(truths.state), look, params)
    seen &= noise.detected < params.detection_probability
    return jax.lax.cond(
        jnp.any(seen) | (params.clutter_rate > 0),
        lambda: _measure(truths, seen, look, noise, static, params),
        lambda: (Detections.none(static.max_detections), jnp.asarray(0)),
    )


def _measure(
    truths: Truths, seen: jax.Array, look: jax.Array, noise: SensorNoise, static: StaticParams, params: Params
) -> tuple[Detections, jax.Array]:
    """Detections of the truths seen `[N]` and of clutter, and how many were lost."""
    points = spherical(position(truths.state))
    value = wrap_detection(points + measurement_sigmas(params) * noise.detection)
    num_clutter, excess = clutter_count(noise.clutter_count, static, params)
    is_clutter = jnp.arange(static.max_clutter) < num_clutter
    false_value = spherical(clutter_points(noise.clutter, look, params))

    detections, num_dropped = _compact(
        jnp.concatenate([value, false_value]),
        jnp.concatenate([seen, is_clutter]),
        jnp.concatenate([jnp.arange(static.num_truths), jnp.full(static.max_clutter, NO_TRUTH)]),
        static.max_detections,
    )
    return detections, num_dropped + excess


def clutter_count(uniform: jax.Array, static: StaticParams, params: Params) -> tuple[jax.Array, jax.Array]:
    """Poisson number of false detections from one uniform draw, and its excess over capacity."""
    number = poisson_quantile(uniform, params.clutter_rate, 4 * static.max_clutter)
    return jnp.minimum(number, static.max_clutter), jnp.maximum(number - static.max_clutter, 0)


def clutter_points(uniform: jax.Array, look: jax.Array, params: Params) -> jax.Array:
    """Places `[C, 3]` (m) of false detections, uniform in the beam's angles and in range."""
    bearing = params.beam_azimuth * (uniform[:, 0] - 0.5)
    elevation = params.beam_elevation * (uniform[:, 1] - 0.5)
    distance = params.min_range + (params.max_range - params.min_range) * uniform[:, 2]
    return platform_frame(distance[:, None] * direction(bearing, elevation), look)


def _compact(
    value: jax.Array, active: jax.Array, truth: jax.Array, capacity: int
) -> tuple[Detections, jax.Array]:
    """Moves the active rows to the front, keeps `capacity` of them, counts the rest."""
    kept, source = matches(jnp.ones(capacity, dtype=bool), active)
    detections = Detections(
        value=jnp.where(kept[:, None], value[source], 0.0),
        active=kept,
        truth=jnp.where(kept, truth[source], NO_TRUTH),
    )
    return detections, jnp.sum(active) - jnp.sum(kept)
