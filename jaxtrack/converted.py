"""The Kalman filter on detections converted to positions (converted measurement Kalman filter).

Counterparts in Stone Soup: `KalmanUpdater`, with detections that carry a `LinearGaussian` model each.
Its filter is linear and needs no Jacobian of the tracks; what it gives up is that the noise of an
angle is taken to be Gaussian in metres.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack import kalman
from jaxtrack.association import Measure
from jaxtrack.kalman import ExpectedDetections
from jaxtrack.lifecycle import position_noise
from jaxtrack.models import inverse_elevation_bearing_range
from jaxtrack.params import Params
from jaxtrack.square_root import position_noise_root
from jaxtrack.types import Detections, Tracks


class Positions(struct.PyTreeNode):
    """Detections converted to positions.

    Attributes:
        value: `[D, 3]` positions (m).
        noise: `[D, 3, 3]` their noise covariances ``G R G^T`` (m^2), G the Jacobian of the
            inverse measurement at the detection.
        root: `[D, 3, 3]` factors of the noise (m), for the covariance form `square_root`.
    """

    value: jax.Array  # [D, 3]
    noise: jax.Array  # [D, 3, 3]
    root: jax.Array  # [D, 3, 3]


def convert(detections: Detections, params: Params) -> Positions:
    """The positions at which detections `[D]` were seen."""
    return Positions(
        value=inverse_elevation_bearing_range(detections.value),
        noise=position_noise(detections.value, params),
        root=position_noise_root(detections.value, params),
    )


def distances(
    expected: ExpectedDetections, positions: Positions, measure: Measure, params: Params
) -> jax.Array:
    """Distances `[T, D]` of positions from the expected ones, each with its own noise."""

    def of_one(value: jax.Array, noise: jax.Array) -> jax.Array:
        seen = expected.replace(covariance=expected.covariance + noise)
        return measure(seen, Detections.from_values(value[None]), params)[:, 0]

    return jax.vmap(of_one, out_axes=1)(positions.value, positions.noise)


def update(
    predicted: Tracks, expected: ExpectedDetections, positions: Positions, associated: jax.Array
) -> Tracks:
    """`kalman.update` with positions in place of detections."""
    own, factors = jnp.maximum(associated, 0), expected.factors
    seen = expected.replace(
        covariance=expected.covariance + positions.noise[own],
        factors=None if factors is None else factors.replace(noise=positions.root[own]),
    )
    return kalman.update(predicted, seen, Detections.from_values(positions.value), associated)
