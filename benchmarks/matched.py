"""Single tracks whose filter has the right models, and their normalised errors."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxtrack import kalman, lifecycle
from jaxtrack.models import (
    direction,
    elevation_bearing_range,
    interleave,
    measurement_sigmas,
    spherical,
    wrap_detection,
)
from jaxtrack.params import Params
from jaxtrack.truth import move_truths
from jaxtrack.types import DETECTION_DIM, STATE_DIM, Detections, Tracks, Truths
from train.episode_metrics import nees

CHUNK = 1000
"""Runs in one call."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Where the targets are, how often and how well they are seen.

    Attributes:
        distance: from the radar at the start (m).
        azimuth: at the start (degrees).
        elevation: at the start (degrees).
        time_step: between detections (s).
        angle_sigma: of measured elevation and bearing (rad).
    """

    distance: float
    azimuth: float = 0.0
    elevation: float = 0.0
    time_step: float = 0.5
    angle_sigma: float = 2e-3

    def params(self) -> Params:
        """The paper's numbers but for these, with truths that move as the filter assumes."""
        base = Params()
        return dataclasses.replace(
            base,
            time_step=self.time_step,
            elevation_sigma=self.angle_sigma,
            bearing_sigma=self.angle_sigma,
            truth_process_noise=base.process_noise,
            truth_velocity_sigma=base.prior_velocity_sigma,
        )


CASES = {
    "1 km, ahead": Case(1_000.0, time_step=0.1),
    "5 km, aside and above": Case(5_000.0, azimuth=-45.0, elevation=30.0),
    "10 km, ahead": Case(10_000.0, time_step=1.0),
    "10 km, corner of the field": Case(10_000.0, azimuth=60.0, elevation=60.0, time_step=1.0),
    "10 km, behind": Case(10_000.0, azimuth=180.0, time_step=1.0),
    "10 km, 10 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.01),
    "10 km, 20 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.02),
    "10 km, 50 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.05),
}


class Errors(struct.PyTreeNode):
    """Normalised errors squared of runs `[R]` after each step `[K]`.

    Attributes:
        nees: `[K, R]` of the estimate after the update, ``e' P^-1 e``.
        nis: `[K, R]` of the detection before it, ``v' S^-1 v``.
    """

    nees: jax.Array
    nis: jax.Array


def simulate(
    key: jax.Array, place: jax.Array, world: Params, params: Params, start: str, runs: int, steps: int
) -> Errors:
    """Follows each of `runs` truths with a track of its own, by the tracker's functions.

    Args:
        key: random key.
        place: `[3]` elevation, bearing (rad) and range (m) of all truths at the start.
        world: numbers of what happens: process noise of the truths, noise of the detections.
        params: numbers of the filter; those of the world, if the models match.
        start: "prior" draws each truth from the Gaussian that its track begins with; "detection"
            begins each track with a detection of its truth.
        runs: number of truths, R.
        steps: number of detections, K.
    """
    key_start, key_steps = jax.random.split(key)
    begin = {"prior": from_prior, "detection": from_detection}[start]
    state, mean, covariance = begin(key_start, place, world, params, runs)
    own = jnp.arange(runs)
    alive = jnp.ones(runs, dtype=bool)
    tracks = Tracks.empty(runs).replace(mean=mean, covariance=covariance, active=alive)

    def step(carry: tuple[Truths, Tracks], key: jax.Array) -> tuple[tuple[Truths, Tracks], Errors]:
        truths, tracks = carry
        key_motion, key_noise = jax.random.split(key)
        truths = move_truths(truths, jax.random.normal(key_motion, (runs, 3, 2)), world)
        value = measure(key_noise, elevation_bearing_range(truths.state), world)
        predicted = kalman.predict(tracks, params.time_step, params)
        expected = kalman.predict_detections(predicted, params)
        tracks = kalman.update(predicted, expected, Detections.from_values(value), own)
        errors = Errors(
            nees=nees(truths.state - tracks.mean, tracks.covariance),
            nis=quadratic(wrap_detection(value - expected.mean), expected.covariance),
        )
        return (truths, tracks), errors

    truths = Truths(state=state, alive=alive)
    return jax.lax.scan(step, (truths, tracks), jax.random.split(key_steps, steps))[1]


Beginning = tuple[jax.Array, jax.Array, jax.Array]
"""True states `[R, 6]`, and means `[R, 6]` and covariances `[R, 6, 6]` of their tracks."""


def from_prior(key: jax.Array, place: jax.Array, world: Params, params: Params, runs: int) -> Beginning:
    """All tracks begin alike, and the truths are drawn from their Gaussian: an exact match."""
    del world
    mean, covariance = lifecycle.initial_estimate(jnp.broadcast_to(place, (runs, DETECTION_DIM)), params)
    noise = jax.random.normal(key, (runs, STATE_DIM))
    return mean + (jnp.linalg.cholesky(covariance) @ noise[..., None])[..., 0], mean, covariance


def from_detection(key: jax.Array, place: jax.Array, world: Params, params: Params, runs: int) -> Beginning:
    """All truths begin in one place, each track with a detection, as the tracker initiates it."""
    key_velocity, key_noise = jax.random.split(key)
    elevation, bearing, distance = place
    point = distance * jnp.broadcast_to(direction(bearing, elevation), (runs, 3))
    velocity = world.truth_velocity_sigma * jax.random.normal(key_velocity, (runs, 3))
    detection = measure(key_noise, spherical(point), world)
    return interleave(point, velocity), *lifecycle.initial_estimate(detection, params)


def measure(key: jax.Array, places: jax.Array, world: Params) -> jax.Array:
    """Detections `[R, 3]` of truths at elevations, bearings and ranges `[R, 3]`."""
    return wrap_detection(places + measurement_sigmas(world) * jax.random.normal(key, places.shape))


def quadratic(difference: jax.Array, covariance: jax.Array) -> jax.Array:
    """``v' S^-1 v`` `[R]` of `[R, 3]` and `[R, 3, 3]`."""
    solved = jnp.linalg.solve(covariance, difference[..., None])[..., 0]
    return jnp.sum(difference * solved, axis=-1)


_simulate = jax.jit(simulate, static_argnames=("start", "runs", "steps"))


def simulate_case(
    case: Case, start: str, runs: int, steps: int, key: jax.Array, world: Params | None = None
) -> Errors:
    """All runs of a case, on the host, `CHUNK` at a time; the models match unless `world` is another."""
    params, angles = case.params(), [math.radians(case.elevation), math.radians(case.azimuth)]
    place = wrap_detection(jnp.array([*angles, case.distance], dtype=float))
    pieces = []
    for first in range(0, runs, CHUNK):
        few, own = min(CHUNK, runs - first), jax.random.fold_in(key, first)
        pieces.append(jax.device_get(_simulate(own, place, world or params, params, start, few, steps)))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *pieces)
