"""Single tracks in extreme cases, followed with every filter, in both covariance forms and precisions."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxtrack import converted, kalman, lifecycle
from jaxtrack.params import Params, StaticParams
from jaxtrack.types import Detections, Tracks

TIME_STEP = 0.1
"""Time between detections (s)."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Where the targets are, how well they are seen, and how little is known of them at first.

    Attributes:
        distance: from the radar at the start (m).
        angle_sigma: of measured elevation and bearing (rad).
        range_sigma: of measured range (m); no more than a hundredth of the distance is taken.
        prior_velocity_sigma: of a new track, each axis (m/s).
    """

    distance: float
    angle_sigma: float
    range_sigma: float
    prior_velocity_sigma: float

    def params(self) -> Params:
        """The paper's numbers but for these; close by, targets manoeuvre less, so that they stay there."""
        return dataclasses.replace(
            Params(),
            time_step=TIME_STEP,
            elevation_sigma=self.angle_sigma,
            bearing_sigma=self.angle_sigma,
            range_sigma=min(self.range_sigma, self.distance / 100),
            prior_velocity_sigma=self.prior_velocity_sigma,
            process_noise=min(1.0, (self.distance / 1000) ** 2),
        )


DISTANCES = (1.0, 100.0, 1e4, 1e6)
ANGLE_SIGMAS = (2e-3, 1e-6)
RANGE_SIGMAS = (5.0, 1e-6)
PRIORS = (30.0, 1e6)
CASES = tuple(Case(*numbers) for numbers in itertools.product(DISTANCES, ANGLE_SIGMAS, RANGE_SIGMAS, PRIORS))


class Estimates(struct.PyTreeNode):
    """Estimates after every update of N tracks in each of C cases.

    Attributes:
        mean: `[C, K, N, 6]` (m, m/s).
        covariance: `[C, K, N, 6, 6]` (m^2, m^2/s, m^2/s^2).
    """

    mean: jax.Array
    covariance: jax.Array


def simulate(case: Case, tracks: int, updates: int, rng: np.random.Generator) -> np.ndarray:
    """Detections `[K + 1, N, 3]` of one target each, all around the radar within a radian of the horizon."""
    params = case.params()
    elevation, bearing = rng.uniform(-1, 1, tracks), rng.uniform(-np.pi, np.pi, tracks)
    ahead = [np.cos(elevation) * np.cos(bearing), np.cos(elevation) * np.sin(bearing), np.sin(elevation)]
    place = case.distance * np.stack(ahead, axis=-1)
    velocity = min(30.0, case.distance / 100) * rng.standard_normal((tracks, 3))
    sigmas = np.array([params.elevation_sigma, params.bearing_sigma, params.range_sigma])
    seen = []
    for _ in range(updates + 1):
        x, y, z = place.T
        ground = np.hypot(x, y)
        exact = np.stack([np.arctan2(z, ground), np.arctan2(y, x), np.hypot(ground, z)], axis=-1)
        seen.append(exact + sigmas * rng.standard_normal(exact.shape))
        place = place + TIME_STEP * velocity
        velocity = velocity + np.sqrt(params.process_noise * TIME_STEP) * rng.standard_normal(velocity.shape)
    return np.stack(seen)


def follow(seen: np.ndarray, cases: tuple[Case, ...], static: StaticParams, double: bool) -> Estimates:
    """The estimates, on the host, of detections `[C, K + 1, N, 3]`, with float64 or float32 throughout."""
    kind = np.float64 if double else np.float32
    params = jax.tree.map(lambda *one: np.array(one, kind), *(case.params() for case in cases))
    with jax.enable_x64(double):
        return jax.device_get(_follow(seen.astype(kind), params, static))


@partial(jax.jit, static_argnames="static")
def _follow(seen: jax.Array, params: Params, static: StaticParams) -> Estimates:
    return jax.vmap(partial(_follow_case, static=static))(seen, params)


def _follow_case(seen: jax.Array, params: Params, static: StaticParams) -> Estimates:
    """By the tracker's functions: the first detections initiate, each other updates its own track."""
    count = seen.shape[1]
    all_new, own = jnp.ones(count, dtype=bool), jnp.arange(count)
    first, empty = Detections.from_values(seen[0]), lifecycle.no_tracks(count, static)
    tracks, _ = lifecycle.initiate_tracks(empty, first, all_new, jnp.asarray(0), params)

    def step(tracks: Tracks, value: jax.Array) -> tuple[Tracks, Estimates]:
        predicted = kalman.predict(tracks, params.time_step, params)
        expected = kalman.FILTERS[static.filter](predicted, params)
        detections = Detections.from_values(value)
        if static.filter == "converted":
            tracks = converted.update(predicted, expected, converted.convert(detections, params), own)
        else:
            tracks = kalman.update(predicted, expected, detections, own)
        return tracks, Estimates(tracks.mean, tracks.covariance)

    return jax.lax.scan(step, tracks, seen[1:])[1]
