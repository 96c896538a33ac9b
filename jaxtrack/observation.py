"""What the agent sees: the track list, its mask, and the scan map (paper, eq. 3 to 5)."""

import jax
import jax.numpy as jnp

from jaxtrack.models import elevation_bearing_range
from jaxtrack.params import Params, StaticParams
from jaxtrack.types import STATE_DIM, Tracks, position, velocity

TRACK_FEATURES = 7
"""Range, azimuth, elevation, vx, vy, vz, Frobenius norm of the covariance."""

CONFIRMED_SHARE = 0.9
"""A track is confirmed once the variance of its velocity is below this share of a new track's."""

Observation = dict[str, jax.Array]


def observe(tracks: Tracks, scan_map: jax.Array, params: Params, with_variances: bool = False) -> Observation:
    """The observation.

    Returns:
        `tracks` `[T, 7]` scaled features, zero where there is no track; `mask` `[T]` where
        there is one; `scan_map` `[M, M]` in [0, 1]; and if asked for, `variances` `[T, 2]` of
        position and of velocity, each summed over the axes, per deletion threshold.
    """
    features = track_features(tracks) / feature_scales(params)
    # Reading row r of a slot that is empty must give exact zeros, whatever it holds.
    padded = jnp.where(tracks.active[:, None], features, 0.0)
    observation = {"tracks": padded, "mask": tracks.active, "scan_map": scan_map}
    if with_variances:
        shares = variances(tracks) / params.deletion_threshold
        observation["variances"] = jnp.where(tracks.active[:, None], shares, 0.0)
    return observation


def track_features(tracks: Tracks) -> jax.Array:
    """Unscaled features `[T, 7]`: m, rad, rad, m/s three times, m^2."""
    elevation, azimuth, distance = jnp.moveaxis(elevation_bearing_range(tracks.mean), -1, 0)
    norm = covariance_norms(tracks)
    return jnp.concatenate(
        [
            jnp.stack([distance, azimuth, elevation], axis=-1),
            velocity(tracks.mean),
            norm[:, None],
        ],
        axis=-1,
    )


def variances(tracks: Tracks) -> jax.Array:
    """Sums `[T, 2]` over the axes of the variances of position (m^2) and of velocity (m^2/s^2)."""
    of_state = jnp.diagonal(tracks.covariance, axis1=-2, axis2=-1)
    return jnp.stack([position(of_state).sum(axis=-1), velocity(of_state).sum(axis=-1)], axis=-1)


def confirmed(active: jax.Array, of_velocity: jax.Array, params: Params) -> jax.Array:
    """`[T]` whether a track is one of more than one detection: its velocity is known better than a new one's.

    A false track rarely is.

    Args:
        active: `[T]` where there is a track.
        of_velocity: `[T]` variance of its velocity, the sum over the axes (m^2/s^2).
        params: numbers; the standard deviation of a new track's velocity.
    """
    return active & (of_velocity < CONFIRMED_SHARE * 3 * params.prior_velocity_sigma**2)


def complete(tracks: Tracks, static: StaticParams, params: Params) -> jax.Array:
    """`[]` whether there are as many confirmed tracks as there can be truths."""
    return jnp.sum(confirmed(tracks.active, variances(tracks)[:, 1], params)) >= static.num_truths


def feature_scales(params: Params) -> jax.Array:
    """Fixed divisors `[7]` that bring the features near [-1, 1]."""
    speed = 3 * params.prior_velocity_sigma
    return jnp.array(
        [
            params.max_range,
            params.field_limit,
            params.field_limit,
            speed,
            speed,
            speed,
            params.deletion_threshold,
        ],
        dtype=float,
    )


def covariance_norms(tracks: Tracks) -> jax.Array:
    """Frobenius norm `[T]` of every slot's 6x6 covariance, mixed units as in Stone Soup."""
    entries = tracks.covariance.reshape(*tracks.active.shape, STATE_DIM**2)
    return jnp.sqrt(jnp.sum(entries**2, axis=-1))
