"""Random scenarios for trackers: everything that a scenario can be is drawn.

Truths, their motion, what is detected of them and all numbers of the tracker, without a
sensor or an environment: the detections are given, so that both sides get the same.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxtrack.models import constant_velocity
from jaxtrack.params import Params
from jaxtrack.types import NO_TRUTH, Detections, Truths
from reference.components import noise_sigmas
from reference.parity.scenes import spherical, unit_vectors

KINDS = ("field", "wrap", "overhead", "around", "crowded")
"""In the field, across the seam of bearings, across the zenith, everywhere, and all in one place."""

MAX_TRUTHS = 8
MAX_DETECTIONS = 16


@dataclasses.dataclass(frozen=True)
class Scenario:
    """One random scenario of K steps, in numpy.

    Attributes:
        kind: one of `KINDS`.
        params: numbers of the tracker and of the scenario.
        truths: `[K, N]` the true targets, in float64.
        detections: `[K, D]` what both trackers get, in float64.
    """

    kind: str
    params: Params
    truths: Truths
    detections: Detections


def random_scenario(seed: int, steps: int) -> Scenario:
    """Scenario number `seed`; the kinds take turns."""
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    params = random_params(rng)
    state: Any = random_truths(rng, kind, steps, params)
    alive: Any = random_lifetimes(rng, steps, state.shape[1])
    detections = random_detections(rng, state, alive, params)
    return Scenario(kind, params, Truths(state=state, alive=alive), detections)


def random_params(rng: np.random.Generator) -> Params:
    """Every number of the tracker, over the ranges that a user might choose."""
    velocity_sigma = rng.uniform(10, 60)
    angle_sigma = np.exp(rng.uniform(np.log(0.2e-3), np.log(5e-3), 2))
    # From a prior that is at once too uncertain to one that survives several misses.
    threshold = (3 * velocity_sigma**2 + 2 * (5000 * angle_sigma.max()) ** 2) * rng.uniform(0.9, 3)
    return Params(
        time_step=int(np.exp(rng.uniform(np.log(5), np.log(1000)))) / 1000,
        min_range=1000.0,
        max_range=20_000.0,
        truth_velocity_sigma=rng.uniform(0, velocity_sigma),
        truth_process_noise=rng.uniform(0, 30),
        elevation_sigma=float(angle_sigma[0]),
        bearing_sigma=float(angle_sigma[1]),
        range_sigma=rng.uniform(1, 30),
        detection_probability=rng.uniform(0.3, 1),
        clutter_rate=float(rng.choice([0.0, rng.uniform(0, 0.5)])),
        process_noise=rng.uniform(0.1, 30),
        gate_threshold=rng.uniform(1.5, 8),
        missed_distance=rng.uniform(1.5, 8),
        prior_velocity_sigma=velocity_sigma,
        deletion_threshold=threshold,
    )


def random_truths(rng: np.random.Generator, kind: str, steps: int, params: Params) -> np.ndarray:
    """Constant-velocity states `[K, N, 6]` of a random number of truths."""
    count = int(rng.integers(1, MAX_TRUTHS + 1))
    azimuth = rng.uniform(-np.pi / 3, np.pi / 3, count)
    elevation = rng.uniform(-np.pi / 3, np.pi / 3, count)
    distance = np.exp(rng.uniform(np.log(params.min_range), np.log(params.max_range), count))
    if kind == "wrap":
        azimuth, elevation = np.pi + 0.01 * azimuth, 0.5 * elevation
    elif kind == "overhead":
        azimuth, elevation = 3 * azimuth, rng.uniform(1.3, 1.55, count)
    elif kind == "around":
        azimuth, elevation = 3 * azimuth, 1.4 * elevation
    elif kind == "crowded":
        azimuth, elevation, distance = azimuth[:1], elevation[:1], distance[:1]
    states = np.empty((steps, count, 6))
    spread = 5 * params.range_sigma if kind == "crowded" else 0.0
    positions = distance[:, None] * unit_vectors(azimuth, elevation)
    states[0, :, 0::2] = positions + spread * rng.standard_normal((count, 3))
    states[0, :, 1::2] = params.truth_velocity_sigma * rng.standard_normal((count, 3))
    F, Q = (np.asarray(m) for m in constant_velocity(params.time_step, params.truth_process_noise))
    noise = rng.multivariate_normal(np.zeros(6), Q, (steps, count), method="eigh")
    for step in range(1, steps):
        states[step] = states[step - 1] @ F.T + noise[step]
    return states


def random_lifetimes(rng: np.random.Generator, steps: int, count: int) -> np.ndarray:
    """`[K, N]` alive: half of the truths for all the time, the others begin late or end early."""
    begin = np.where(rng.random(count) < 0.5, 0, rng.integers(0, steps, count))
    end = np.where(rng.random(count) < 0.5, steps, rng.integers(0, steps, count) + 1)
    step = np.arange(steps)[:, None]
    return (step >= begin) & (step < end)


def random_detections(
    rng: np.random.Generator, state: np.ndarray, alive: np.ndarray, params: Params
) -> Detections:
    """Detections `[K, D]` of the truths, missed ones left out, and clutter near and far; shuffled."""
    steps = len(state)
    value: Any = np.zeros((steps, MAX_DETECTIONS, 3))
    truth: Any = np.full((steps, MAX_DETECTIONS), NO_TRUTH)
    active: Any = np.zeros((steps, MAX_DETECTIONS), dtype=bool)
    sigma = noise_sigmas(params)
    looked_at = rng.uniform(0.3, 1)  # share of the steps in which anything is looked at
    for step in range(steps):
        if rng.random() > looked_at:
            continue
        seen = np.flatnonzero(alive[step] & (rng.random(alive.shape[1]) < params.detection_probability))
        found = spherical(state[step, seen, 0::2]) + sigma * rng.standard_normal((len(seen), 3))
        clutter = random_clutter(rng, state[step], params)[: MAX_DETECTIONS - len(seen)]
        found = wrapped(np.concatenate([found, clutter]))
        source = np.concatenate([seen, np.full(len(clutter), NO_TRUTH)])
        rows = rng.permutation(len(found))
        value[step, : len(found)] = found[rows]
        truth[step, : len(found)] = source[rows]
        active[step, : len(found)] = True
    return Detections(value=value, active=active, truth=truth)


def random_clutter(rng: np.random.Generator, state: np.ndarray, params: Params) -> np.ndarray:
    """False detections `[C, 3]`: half a few sigmas from a truth, half in any direction."""
    count = rng.poisson(params.clutter_rate)
    near = spherical(state[rng.integers(0, len(state), count), 0::2])
    near += 6 * noise_sigmas(params) * rng.standard_normal((count, 3))
    far = np.stack(
        [
            rng.uniform(-1.5, 1.5, count),
            rng.uniform(-np.pi, np.pi, count),
            rng.uniform(params.min_range, params.max_range, count),
        ],
        axis=1,
    )
    return np.where(rng.random((count, 1)) < 0.5, near, far)


def wrapped(value: np.ndarray) -> np.ndarray:
    """Detections `[..., 3]` as a radar reports them: elevation folded, bearing wrapped."""
    elevation, bearing, distance = np.moveaxis(value, -1, 0)
    elevation = np.arcsin(np.sin(elevation))
    return np.stack([elevation, (bearing + np.pi) % (2 * np.pi) - np.pi, np.abs(distance)], -1)
