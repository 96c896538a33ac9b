"""Random track lists and detections around a direction: the material of single-step tests."""

import jax.numpy as jnp
import numpy as np

from jaxtrack import NO_DETECTION, Detections, Params, Tracks
from reference.components import noise_sigmas

Direction = tuple[float, float]

AHEAD, BEHIND, UP = (0.3, 0.2), (np.pi, 0.1), (0.5, 1.45)
"""Directions (azimuth, elevation): the plain one, bearing wrap, elevation fold."""


def unit_vectors(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Unit vectors `[..., 3]` towards angles (rad)."""
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)],
        axis=-1,
    )


def spherical(points: np.ndarray) -> np.ndarray:
    """Elevation, bearing (rad), range (m) `[..., 3]` of positions `[..., 3]` (m)."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x), np.linalg.norm(points, axis=-1)], -1)


def random_means(
    rng: np.random.Generator,
    count: int,
    towards: Direction,
    spread: float = 0.05,
    distance: tuple[float, float] = (1500.0, 6000.0),
) -> np.ndarray:
    """States `[count, 6]` around a direction (azimuth, elevation in rad)."""
    angles = np.array(towards) + spread * rng.standard_normal((count, 2))
    mean = np.zeros((count, 6))
    mean[:, 0::2] = rng.uniform(*distance, (count, 1)) * unit_vectors(angles[:, 0], angles[:, 1])
    mean[:, 1::2] = 30.0 * rng.standard_normal((count, 3))
    return mean


def random_covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    """Positive definite `[count, 6, 6]` with correlations, sigmas of 2-15 m and 1-25 m/s."""
    factor = rng.standard_normal((count, 6, 8))
    covariance = factor @ factor.transpose(0, 2, 1)
    sigma = np.where(np.arange(6) % 2 == 0, rng.uniform(2, 15, (count, 6)), rng.uniform(1, 25, (count, 6)))
    scale = sigma / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    covariance = covariance * scale[:, :, None] * scale[:, None, :]
    return (covariance + covariance.transpose(0, 2, 1)) / 2


def track_list(mean: np.ndarray, covariance: np.ndarray, max_tracks: int | None = None) -> Tracks:
    """Track list with one track per row, born on step 0 from detections 0, 1, ..."""
    count = len(mean)
    padding = 0 if max_tracks is None else max_tracks - count
    active = np.arange(count + padding) < count
    return Tracks(
        mean=jnp.asarray(np.pad(mean, ((0, padding), (0, 0)))),
        covariance=jnp.asarray(np.pad(covariance, ((0, padding), (0, 0), (0, 0)))),
        active=jnp.asarray(active),
        updated_by=jnp.full(count + padding, NO_DETECTION),
        birth_step=jnp.where(active, 0, NO_DETECTION),
        birth_detection=jnp.where(active, jnp.arange(count + padding), NO_DETECTION),
        age=jnp.zeros(count + padding, dtype=int),
    )


def random_tracks(
    rng: np.random.Generator,
    count: int,
    towards: Direction = AHEAD,
    max_tracks: int | None = None,
    spread: float = 0.05,
    distance: tuple[float, float] = (1500.0, 6000.0),
) -> Tracks:
    """Track list of random means and covariances."""
    mean = random_means(rng, count, towards, spread, distance)
    return track_list(mean, random_covariances(rng, count), max_tracks)


def detections_near(
    rng: np.random.Generator, tracks: Tracks, params: Params, count: int, sigmas: float = 1.5
) -> np.ndarray:
    """Detections `[count, 3]` of randomly chosen live tracks, so that some are contested."""
    live = np.flatnonzero(np.asarray(tracks.active))
    chosen = rng.choice(live, count)
    mean, covariance = np.asarray(tracks.mean)[chosen], np.asarray(tracks.covariance)[chosen]
    shaken = np.linalg.cholesky(covariance) @ rng.standard_normal((count, 6, 1)) * sigmas
    value = spherical((mean + shaken[..., 0])[:, 0::2])
    return value + noise_sigmas(params) * rng.standard_normal((count, 3))


def padded(value: np.ndarray, capacity: int) -> Detections:
    """Detections of `value` `[D, 3]` with empty rows up to `capacity`."""
    rows = len(value)
    full = np.zeros((capacity, 3))
    full[:rows] = value
    return Detections.from_values(jnp.asarray(full), jnp.arange(capacity) < rows)
