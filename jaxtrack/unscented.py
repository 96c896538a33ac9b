"""The unscented transform of track states into detections, and the cubature transform.

Counterparts in Stone Soup: the measurement predictions of `UnscentedKalmanUpdater` and
`CubatureKalmanUpdater` with their typed angles (circular means, wrapped bearings, folded elevations).

All detections are taken relative to the centre point's. With weights that sum to 1 its large
negative weight then cancels exactly instead of in rounding, which is what makes float32
possible. The numbers are those of ``zbar = sum w z`` and ``S = sum w (z - zbar)(z - zbar)^T + R``,
angles averaged by their sines and cosines.

Tracks come last in every array, and what belongs to a sigma point of a track is one long row
`[12 T]`, point by point: a CPU works on many numbers at once only along long rows.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxtrack.kernel import add_up, stage
from jaxtrack.matrices import cholesky, product, triangular_factor
from jaxtrack.models import (
    arctan2,
    less_sine,
    measurement_sigmas,
    spherical,
    spherical_offsets,
    wrap_detection,
)
from jaxtrack.params import Params
from jaxtrack.types import POSITION, STATE_DIM

POINTS = 2 * STATE_DIM
"""Sigma points besides the centre."""


class Relative(NamedTuple):
    """Detections of the sigma points relative to the centre point's, each `[12 T]`."""

    elevation_sine: jax.Array
    elevation_cosine: jax.Array
    bearing_sine: jax.Array
    bearing_cosine: jax.Array
    range: jax.Array


def unscented_transform(
    mean: jax.Array, covariance: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Expected detections of states with means `[6, T]` and covariances `[6, 6, T]`.

    Returns:
        Expected elevation, bearing, range `[3, T]`; innovation covariances `[3, 3, T]`,
        measurement noise included; covariances `[6, 3, T]` between state and detection.
    """
    expected, S, C, _ = _transform(mean, covariance, params)
    return expected, S, C


def cubature_transform(
    mean: jax.Array, covariance: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`unscented_transform` with the 12 cubature points, all of one weight, and none at the centre.

    Stone Soup subtracts products of means from means of products. As angles have circular means,
    their differences from these do not quite add up to zero, and what they leave in S and in the
    covariance with the state is kept here in float64. It changes S by 1e-3 where the points lie 0.1 rad
    apart, and can leave an updated covariance indefinite, in Stone Soup as here; float32 does without it,
    as the textbook does. Stone Soup does not wrap the products, though, which spoils S where the points
    lie on both sides of the seam of bearings at pi; here differences are wrapped.

    I. Arasaratnam, S. Haykin, "Cubature Kalman filters", IEEE Transactions on Automatic Control 54 (2009).
    """
    expected, S, C, differences = _transform(mean, covariance, cubature(params))
    if mean.dtype == jnp.float32:
        return expected, S, C
    left = jnp.stack([*map(_left_by_circular_mean, differences[:2]), jnp.zeros_like(mean[0])])
    of_means = expected[:, None] * left
    return expected, S + of_means + jnp.swapaxes(of_means, 0, 1), C + mean[:, None] * left


@stage
def _left_by_circular_mean(differences: jax.Array) -> jax.Array:
    """Mean `[T]` of differences `[12 T]` (rad) of angles from their circular mean, which is not quite zero.

    Their sines add up to zero, so it is the mean of ``d - sin(d)`` as well. Of a mrad that is 1e-10, with
    a rounding to match: the mean gets multiplied by positions, and that of the differences themselves
    would cost 1e-10 sigma in every update at 10 km.
    """
    return _sum_points(less_sine(differences)) / POINTS


def cubature(params: Params) -> Params:
    """The scaling with which the unscented transform is the cubature transform."""
    return dataclasses.replace(params, alpha=1.0, beta=0.0, kappa=0.0)


def square_root_transform(
    mean: jax.Array, root: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`unscented_transform` of states with lower triangular factors `[6, 6, T]`, in factors.

    Of a pair of opposite points the difference is what a linear measurement would give, and the mean what
    its curvature adds, for S as noise does. Where points lie so wide around the radar that the centre's
    negative weight makes that noise indefinite, it is left out.

    Returns:
        Expected elevation, bearing, range `[3, T]`; G `[3, 6, T]` and N `[3, 3, T]` as in
        `square_root.Factors`.
    """
    relative = _relative_detections(mean, _spread(params) * jnp.swapaxes(root, 0, 1))
    expected, shift = _mean_detection(mean, relative, params)
    return expected, *_factors(_differences(relative, shift), shift, params)


@stage
def _factors(
    differences: tuple[jax.Array, ...], shift: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array]:
    centre_weight, weight = unscented_weights(params)
    pairs = jnp.stack([difference.reshape(2, STATE_DIM, -1) for difference in differences])
    plus, minus = pairs[:, 0], pairs[:, 1]
    bent = jnp.sqrt(weight / 2) * (plus + minus)
    centre, noise = wrap_detection(-shift, axis=0), jnp.diag(measurement_sigmas(params))[..., None]
    squared = noise**2 + product(bent, jnp.swapaxes(bent, 0, 1)) + centre_weight * centre[:, None] * centre
    N = cholesky(squared)
    without_centre = triangular_factor(jnp.concatenate([bent, jnp.broadcast_to(noise, N.shape)], axis=1))
    is_factor = jnp.isfinite(add_up(add_up(N)))
    return jnp.sqrt(weight / 2) * (plus - minus), jnp.where(is_factor, N, without_centre)


def _transform(
    mean: jax.Array, covariance: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array, jax.Array, tuple[jax.Array, ...]]:
    """`unscented_transform`, and differences `[12 T]` of the points from the expected detections."""
    offsets = sigma_offsets(covariance, params)
    relative = _relative_detections(mean, offsets)
    expected, shift = _mean_detection(mean, relative, params)
    differences = _differences(relative, shift)
    S, C = _covariances(offsets, differences, shift, params)
    return expected, S, C, differences


def unscented_weights(params: Params) -> tuple[jax.Array, jax.Array]:
    """The centre's weight in covariances and the weight of each of the 12 other points.

    With ``c = alpha^2 (n + kappa)`` the others have ``1 / (2 c)``, the centre has
    ``1 - n / c`` in means and that plus ``1 - alpha^2 + beta`` in covariances. Means need
    no centre weight here: they are taken as differences from the centre.
    """
    c = params.alpha**2 * (STATE_DIM + params.kappa)
    centre_covariance = 1 - STATE_DIM / c + (1 - params.alpha**2 + params.beta)
    return jnp.asarray(centre_covariance, dtype=float), jnp.asarray(1 / (2 * c), dtype=float)


@stage
def sigma_offsets(covariance: jax.Array, params: Params) -> jax.Array:
    """Offsets `[6, 6, T]` (point, component, track) of half the sigma points from the mean.

    The scaled Cholesky columns; the other half are their opposites. Only the lower triangle of
    `covariance` `[6, 6, T]` is read, as LAPACK does for Stone Soup.
    """
    return _spread(params) * jnp.swapaxes(cholesky(covariance), 0, 1)


def _spread(params: Params) -> jax.Array:
    """Distance of the sigma points from the mean in columns of the factor."""
    return jnp.sqrt(params.alpha**2 * (STATE_DIM + params.kappa))


@stage
def _relative_detections(mean: jax.Array, offsets: jax.Array) -> Relative:
    centre = [_for_every_point(mean[axis]) for axis in POSITION]
    halves = [offsets[:, axis].ravel() for axis in POSITION]
    return Relative(*spherical_offsets(centre, [jnp.concatenate([half, -half]) for half in halves]))


@stage
def _mean_detection(mean: jax.Array, relative: Relative, params: Params) -> tuple[jax.Array, jax.Array]:
    """Mean `[3, T]` of the sigma points' detections, and how far it lies from the centre point's."""
    _, weight = unscented_weights(params)
    elevation = arctan2(
        weight * _sum_points(relative.elevation_sine), 1 - weight * _sum_points(1 - relative.elevation_cosine)
    )
    bearing = arctan2(
        weight * _sum_points(relative.bearing_sine), 1 - weight * _sum_points(1 - relative.bearing_cosine)
    )
    centre = spherical(mean[::2], axis=0)
    change = jnp.stack([elevation, bearing, weight * _sum_points(relative.range)])
    expected = wrap_detection(centre + change, axis=0)
    return expected, expected - centre


@stage
def _differences(relative: Relative, shift: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Differences `[12 T]` of the points' elevations, bearings, ranges from their mean at `shift` `[3, T]`.

    The angles are turned back by the shift; the elevation's is folded, as Stone Soup does.
    """
    sine, cosine = _turn_back(relative.elevation_sine, relative.elevation_cosine, shift[0])
    elevation = arctan2(sine, jnp.abs(cosine))
    sine, cosine = _turn_back(relative.bearing_sine, relative.bearing_cosine, shift[1])
    return elevation, arctan2(sine, cosine), relative.range - _for_every_point(shift[2])


def _turn_back(sine: jax.Array, cosine: jax.Array, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine `[12 T]` of angles less `angle` `[T]`."""
    turn_sine, turn_cosine = _for_every_point(jnp.sin(angle)), _for_every_point(jnp.cos(angle))
    return sine * turn_cosine - cosine * turn_sine, cosine * turn_cosine + sine * turn_sine


@stage
def _covariances(
    offsets: jax.Array, differences: tuple[jax.Array, ...], shift: jax.Array, params: Params
) -> tuple[jax.Array, jax.Array]:
    """S `[3, 3, T]` and C `[6, 3, T]`."""
    centre_weight, weight = unscented_weights(params)
    centre, noise = wrap_detection(-shift, axis=0), measurement_sigmas(params) ** 2
    rows = range(len(differences))
    # Only one of two equal halves is worked out.
    S = {
        (i, j): weight * _sum_points(differences[i] * differences[j])
        + centre_weight * centre[i] * centre[j]
        + (noise[i] if i == j else 0)
        for i in rows
        for j in rows[i:]
    }
    # The offsets come in pairs of opposite sign: half the products do.
    plus_minus = [difference.reshape(2, STATE_DIM, 1, -1) for difference in differences]
    C = [weight * add_up(offsets * (plus - minus)) for plus, minus in plus_minus]
    full = [jnp.stack([S[min(i, j), max(i, j)] for j in rows]) for i in rows]
    return jnp.stack(full), jnp.stack(C, axis=1)


def _sum_points(row: jax.Array) -> jax.Array:
    """`[T]` sum over the sigma points of a row `[12 T]`."""
    return add_up(row.reshape(POINTS, -1))


def _for_every_point(row: jax.Array) -> jax.Array:
    """Row `[12 T]` of `[T]`; faster than `jnp.tile`, which XLA turns into divisions."""
    return jnp.concatenate([row] * POINTS)
