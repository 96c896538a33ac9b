"""How far two results are apart, and how far they may be.

Every error is measured in standard deviations of the quantity itself: a mean against its own
standard deviation, a covariance entry against the two it belongs to. Metres, metres per
second and radians then weigh alike, and nothing small hides behind something large. Against
the size of the quantity (a position of 5 km known to 5 m) this is a thousand times stricter.
"""

import numpy as np
from numpy.typing import ArrayLike

from jaxtrack.tracker import TrackerInfo
from jaxtrack.types import Tracks
from reference.pipeline import Estimate, Expected

TOLERANCE = 1e-9
"""Largest error allowed in float64 with the exact Jacobian."""


def mean_error(ours: ArrayLike, theirs: ArrayLike, covariance: ArrayLike) -> float:
    """Largest |a - b| / sigma of `[..., n]`; angles must agree without a turn of 2 pi between."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return _largest(np.abs(np.asarray(ours) - np.asarray(theirs)) / sigma)


def covariance_error(ours: ArrayLike, theirs: ArrayLike) -> float:
    """Largest |A_ij - B_ij| / (sigma_i sigma_j) of `[..., n, n]`."""
    sigma = np.sqrt(np.diagonal(theirs, axis1=-2, axis2=-1))
    return cross_covariance_error(ours, theirs, sigma, sigma)


def cross_covariance_error(
    ours: ArrayLike, theirs: ArrayLike, sigma_rows: np.ndarray, sigma_columns: np.ndarray
) -> float:
    """Largest |A_ij - B_ij| / (sigma_i sigma_j) of `[..., n, m]`."""
    scale = sigma_rows[..., :, None] * sigma_columns[..., None, :]
    return _largest(np.abs(np.asarray(ours) - np.asarray(theirs)) / scale)


def distance_error(ours: ArrayLike, theirs: ArrayLike) -> float:
    """Largest |a - b| / max(1, b) where Stone Soup computed a distance."""
    theirs = np.asarray(theirs)
    known = ~np.isnan(theirs)
    return _largest(np.abs(np.asarray(ours) - theirs)[known] / np.maximum(1.0, theirs[known]))


def exact_mahalanobis(mean: np.ndarray, S: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Mahalanobis distances `[D]` of detections `[D, 3]` in extended precision.

    Stone Soup inverts S by `pinv`, which for an S of condition 1e10 (rad^2 beside m^2) leaves
    its distances with only eight digits: this is the same formula without that loss.
    """
    d = mean.astype(np.longdouble) - value
    d[:, 0] = np.arcsin(np.sin(d[:, 0]))
    d[:, 1] = (d[:, 1] + np.pi) % (2 * np.pi) - np.pi
    S = S.astype(np.longdouble)
    cofactors = np.stack([np.cross(S[1], S[2]), np.cross(S[2], S[0]), np.cross(S[0], S[1])], axis=-1)
    inverse = cofactors / (S[0] * cofactors[:, 0]).sum()
    return np.sqrt((d @ inverse * d).sum(axis=-1)).astype(float)


def expected_error(info: TrackerInfo, slot: int, expected: Expected) -> float:
    """Largest error of all that is predicted for one track: `TrackerInfo` against `Expected`."""
    S = expected.detection_covariance
    sigma = np.sqrt(np.diag(expected.covariance))
    return _largest(
        [
            mean_error(info.predicted.mean[slot], expected.mean, expected.covariance),
            covariance_error(info.predicted.covariance[slot], expected.covariance),
            mean_error(info.expected.mean[slot], expected.detection_mean, S),
            covariance_error(info.expected.covariance[slot], S),
            cross_covariance_error(
                info.expected.cross_covariance[slot],
                expected.cross_covariance,
                sigma,
                np.sqrt(np.diag(S)),
            ),
            distance_error(info.distances[slot], expected.distances),
        ],
    )


def estimate_error(tracks: Tracks, slot: int, estimate: Estimate) -> float:
    """Largest error of mean and covariance of one track: `Tracks` against `Estimate`."""
    return _largest(
        [
            mean_error(tracks.mean[slot], estimate.mean, estimate.covariance),
            covariance_error(tracks.covariance[slot], estimate.covariance),
        ],
    )


def _largest(errors: ArrayLike) -> float:
    # NaN must fail a comparison with the tolerance, and does; nothing to compare is no error.
    return float(np.max(errors, initial=0.0))
