"""Models, measures, sensor, platform and truths: random inputs to both sides."""

import dataclasses
import datetime
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from stonesoup.sensor.radar.radar import RadarRotatingElevationBearingRange
from stonesoup.types.angle import Bearing, Elevation
from stonesoup.types.detection import GaussianDetection
from stonesoup.types.groundtruth import GroundTruthState
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.types.state import State

from jaxtrack import association, kalman, models, platform, sensor
from jaxtrack.params import Params, StaticParams
from jaxtrack.types import Detections
from reference.components import (
    EPOCH,
    MEASURES,
    build_components,
    measurement_model,
    noise_covariance,
    transition_model,
)
from reference.parity.ours import on_device
from reference.parity.rows import Row
from reference.parity.scenarios import random_params, wrapped
from reference.parity.scenes import random_covariances, random_means, spherical, track_list, unit_vectors
from reference.radar import build_radar, steer
from reference.translate import as_vector, to_detections

Ours = Callable[..., Any]


MEASURED = tuple(name for name in MEASURES if name != "mahalanobis")
"""Measures compared here; the tracker's own is compared on the tracker's own steps."""

NUM_MODELS = 6 + len(MEASURED)


def model_rows(seed: int, count: int) -> Iterator[Row]:
    """One row per model, measure, sensor and platform, `count` random inputs each."""
    rng = np.random.default_rng(seed)
    yield transition_row(rng, count)
    yield angle_row(rng, count)
    yield measurement_row(rng, count)
    yield inverse_row(rng, count)
    for name in MEASURED:
        yield measure_row(rng, count, name)
    yield field_of_view_row(rng, count)
    yield platform_row(rng, count)


def both(ours: Ours, *arguments: Any) -> tuple[Any, Any]:
    """Results of one of our functions in float64 and in float32."""
    compiled = jax.jit(ours)
    return on_device(compiled, True, *arguments), on_device(compiled, False, *arguments)


def transition_row(rng: np.random.Generator, count: int) -> Row:
    """F and Q for time steps of whole microseconds."""
    microseconds = np.exp(rng.uniform(np.log(1e3), np.log(1e7), count)).astype(int)
    noise = rng.uniform(0, 50, count)
    double, single = both(jax.vmap(models.constant_velocity), microseconds / 1e6, noise)
    worst = [0.0, 0.0]
    for i in range(count):
        interval = datetime.timedelta(microseconds=int(microseconds[i]))
        model = transition_model(noise[i])
        theirs = model.matrix(time_interval=interval), model.covar(time_interval=interval)
        for precision, ours in enumerate((double, single)):
            errors = [relative(ours[part][i], theirs[part]) for part in (0, 1)]
            worst[precision] = max(worst[precision], *errors)
    name = "CombinedLinearGaussianTransitionModel of ConstantVelocity"
    return Row("models.constant_velocity", name, count, "matrix pairs", worst[0], worst[1])


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest |a - b| / |b| over the entries that are not zero; infinite where only ours is not."""
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if np.any(ours[theirs == 0] != 0):
        return np.inf
    known = theirs != 0
    return float(np.max(np.abs(ours - theirs)[known] / np.abs(theirs[known]), initial=0.0))


def angle_row(rng: np.random.Generator, count: int) -> Row:
    """Bearings wrapped and elevations folded, over several turns and at multiples of a right angle."""
    angles = np.concatenate([rng.uniform(-12, 12, count), np.pi / 2 * np.arange(-7, 8)])

    def ours(angles: jax.Array) -> Any:
        return models.wrap_bearing(angles), models.fold_elevation(angles)

    theirs = [float(Bearing(a)) for a in angles], [float(Elevation(a)) for a in angles]
    worst = []
    for result in both(ours, angles):
        worst.append(float(np.abs(without_turns(np.asarray(result, float) - np.asarray(theirs))).max()))
    return Row(
        "models.wrap_bearing, fold_elevation", "Bearing, Elevation", len(angles), "angles", worst[0], worst[1]
    )


def without_turns(angle: np.ndarray) -> np.ndarray:
    """Angles (rad) less their whole turns; small ones to the last bit."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    """States `[count, 6]` in all directions, 1 to 20 km away."""
    direction = unit_vectors(rng.uniform(-np.pi, np.pi, count), rng.uniform(-1.55, 1.55, count))
    states = 30.0 * rng.standard_normal((count, 6))
    states[:, 0::2] = rng.uniform(1000, 20_000, (count, 1)) * direction
    return states


def detection_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest error of detections `[..., 3]`: angles in rad, the range relative to itself."""
    gap = np.asarray(ours, float) - theirs
    gap[..., 1] = without_turns(gap[..., 1])
    return float(np.max(np.abs(gap) / np.stack([np.ones_like(theirs[..., 0])] * 2 + [theirs[..., 2]], -1)))


def measurement_row(rng: np.random.Generator, count: int) -> Row:
    """The measurement function."""
    states = places(rng, count)
    model = measurement_model(Params())
    theirs = np.stack([as_vector(model.function(State(state))) for state in states])
    worst = [detection_error(ours, theirs) for ours in both(models.elevation_bearing_range, states)]
    name = "CartesianToElevationBearingRange.function"
    return Row("models.elevation_bearing_range", name, count, "states", worst[0], worst[1])


def inverse_row(rng: np.random.Generator, count: int) -> Row:
    """Its inverse, errors relative to the range."""
    values = wrapped(spherical(places(rng, count)[:, 0::2]))
    model = measurement_model(Params())
    detections = to_detections(values, np.ones(count, bool), 0, EPOCH, model)
    theirs = np.stack([as_vector(model.inverse_function(found))[0::2] for found in detections])
    worst = [
        float(np.max(np.abs(ours - theirs) / values[:, 2:]))
        for ours in both(models.inverse_elevation_bearing_range, values)
    ]
    name = "CartesianToElevationBearingRange.inverse_function"
    return Row("models.inverse_elevation_bearing_range", name, count, "detections", worst[0], worst[1])


MEASURE_NOTES = {
    "squared_mahalanobis": "Stone Soup's own rounding: `pinv` of S, see Mahalanobis",
    "kullback_leibler": "needs `GaussianDetection`; fails with a plain `Detection`",
    "hellinger": "needs `GaussianDetection`; fails with a plain `Detection`",
    "squared_hellinger": "needs `GaussianDetection`; fails with a plain `Detection`",
}
MEASURE_TOLERANCES = {"squared_mahalanobis": 1e-6}


def measure_row(rng: np.random.Generator, count: int, name: str) -> Row:
    """Distances by one measure, four detections per track, and the gate's decisions by it.

    Both sides measure the same expected detections, those of Stone Soup.
    """
    tracks = max(1, count // 4)
    mean, covariance = random_means(rng, tracks, (0.3, 0.2), spread=1.0), random_covariances(rng, tracks)
    params = dataclasses.replace(random_params(rng), gate_threshold=1e9, missed_distance=1e9)
    value = spherical(mean[:, None, 0::2] + 15 * rng.standard_normal((tracks, 4, 3)))
    theirs, expected = stock_distances(mean, covariance, value, params, name)
    limit = float(np.median(theirs))
    params = dataclasses.replace(params, gate_threshold=limit * (1 + 1e-6))

    def ours(expected: kalman.ExpectedDetections, value: jax.Array, params: Params) -> Any:
        def one(expected: kalman.ExpectedDetections, value: jax.Array) -> Any:
            detections = Detections.from_values(value)
            distances = association.MEASURES[name](
                jax.tree.map(lambda leaf: leaf[None], expected), detections, params
            )
            track = track_list(np.zeros((1, 6)), np.eye(6)[None])
            return distances[0], association.gate(distances, track, detections, params)[0]

        return jax.vmap(one)(expected, value)

    worst, gates = [], []
    for distances, admissible in both(ours, expected, value, params):
        worst.append(float(np.max(np.abs(distances - theirs) / np.maximum(1.0, theirs))))
        gates.append(float(np.mean(np.isfinite(admissible) == (theirs < params.gate_threshold))))
    return Row(
        f"association.{name}",
        MEASURES[name].__name__,
        theirs.size,
        "distances",
        float64=worst[0],
        float32=worst[1],
        agreement=gates[0],
        agreement32=gates[1],
        tolerance=MEASURE_TOLERANCES.get(name, 1e-9),
        note=MEASURE_NOTES.get(name, ""),
    )


def stock_distances(
    mean: np.ndarray, covariance: np.ndarray, value: np.ndarray, params: Params, name: str
) -> tuple[np.ndarray, kalman.ExpectedDetections]:
    """Distances `[T, 4]` by the stock hypothesiser, and the expected detections they are from."""
    parts = build_components(params, static=StaticParams(measure=name))
    model = parts.measurement_model
    R = noise_covariance(params)
    distances = np.empty(value.shape[:2])
    expected = []
    for slot in range(len(mean)):
        track = GaussianStatePrediction(mean[slot], covariance[slot], EPOCH)
        detections = [
            GaussianDetection(
                found.state_vector, R, timestamp=EPOCH, measurement_model=parts.measurement_model
            )
            for found in to_detections(value[slot], np.ones(4, bool), 0, EPOCH, model)
        ]
        measured = parts.updater.predict_measurement(track, model)
        expected.append((as_vector(measured.state_vector), np.asarray(measured.covar, float)))
        hypotheses = parts.hypothesiser.hypothesise(track, detections, EPOCH)
        by_detection = {id(one.measurement): one.distance for one in hypotheses if one}
        distances[slot] = [by_detection[id(found)] for found in detections]
    z, S = (np.stack(part) for part in zip(*expected, strict=True))
    fields: dict[str, Any] = {"mean": z, "covariance": S, "cross_covariance": np.zeros((len(z), 6, 3))}
    return distances, kalman.ExpectedDetections(**fields)


def field_of_view_row(rng: np.random.Generator, count: int) -> Row:
    """Whether the beam holds a truth: random looks, points near the border, some behind the radar."""
    params = Params(beam_azimuth=0.2, beam_elevation=0.1)
    looks = np.stack([rng.uniform(-np.pi, np.pi, count), rng.uniform(-1.4, 1.4, count)], -1)
    turned = unit_vectors(rng.uniform(-0.2, 0.2, count), rng.uniform(-0.1, 0.1, count))
    turned *= rng.uniform(500, 9000, (count, 1)) * np.where(rng.random((count, 1)) < 0.1, -1, 1)
    points = on_device(jax.jit(jax.vmap(sensor.platform_frame)), True, turned, looks)
    radar = build_radar(params, RadarRotatingElevationBearingRange)
    theirs = np.empty(count, dtype=bool)
    for i in range(count):
        steer(radar, *looks[i])
        state = np.zeros(6)
        state[0::2] = points[i]
        theirs[i] = radar.is_detectable(GroundTruthState(state, timestamp=EPOCH))
    double, single = both(jax.vmap(sensor.in_beam, in_axes=(0, 0, None)), points, looks, params)
    name = "RadarRotatingElevationBearingRange.is_detectable"
    agreement = float(np.mean(double == theirs)), float(np.mean(single == theirs))
    return Row("sensor.in_beam", name, count, "looks", None, agreement=agreement[0], agreement32=agreement[1])


def platform_row(rng: np.random.Generator, count: int) -> Row:
    """Detections by a radar on a platform somewhere, turned anyhow."""
    states, place = places(rng, count), rng.uniform(-500, 500, (count, 3))
    orientation = rng.uniform(-1, 1, (count, 3)) * [np.pi, 1.5, np.pi]
    theirs = np.empty((count, 3))
    for i in range(count):
        radar = build_radar(Params(), place=tuple(place[i]), orientation=tuple(orientation[i]))
        theirs[i] = as_vector(radar.measurement_model.function(State(states[i])))

    def ours(states: jax.Array, place: jax.Array, orientation: jax.Array) -> jax.Array:
        return models.elevation_bearing_range(platform.to_platform(states, place, orientation))

    worst = [detection_error(result, theirs) for result in both(jax.vmap(ours), states, place, orientation)]
    return Row("platform.to_platform", "FixedPlatform", count, "detections", worst[0], worst[1])
