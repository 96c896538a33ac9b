"""Parts beside the default ones, each against its Stone Soup counterpart on inputs of one step.

Whole episodes with each of them: `reference.parity.parts`, which `test_command` runs.
"""

import dataclasses
import datetime
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.measures import Mahalanobis
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction, SqrtGaussianStatePrediction
from stonesoup.types.state import State
from stonesoup.types.track import Track
from stonesoup.types.update import Update
from stonesoup.updater.kalman import CubatureKalmanUpdater

from jaxtrack import Detections, Params, StaticParams, converted, kalman, lifecycle
from jaxtrack.association import MEASURES
from jaxtrack.counts import MICROSECONDS, Counts
from jaxtrack.params import CONVERTED_MEASURES
from reference import components
from reference.components import EPOCH, build_components, position_model
from reference.parity.compare import (
    TOLERANCE,
    covariance_error,
    cross_covariance_error,
    distance_error,
    estimate_error,
    mean_error,
)
from reference.parity.environment import LIVELY, EnvironmentTallies, compare_environment
from reference.parity.episodes import EpisodeTallies, compare_episode
from reference.parity.free_running import compare
from reference.parity.oracle import Job, run
from reference.parity.ours import episode
from reference.parity.parts import PARTS, scenario_for
from reference.parity.scenes import AHEAD, BEHIND, UP, random_covariances, random_means, track_list
from reference.pipeline import estimate
from reference.translate import as_vector, to_detections, to_position

pytestmark = pytest.mark.usefixtures("quick_compilation")

PARAMS = Params()
COUNT = 20
DIRECTIONS = pytest.mark.parametrize("towards", [AHEAD, BEHIND, UP], ids=["ahead", "behind", "up"])
# Rounding of its own: products as large as the square of a range. Measured within 6 km: 1e-9 standard
# deviations; in whole episodes at up to 20 km, with angles to 0.2 mrad: 2e-8.
STOCK_CUBATURE_TOLERANCE = 1e-8


def scene(towards, seed=3):
    rng = np.random.default_rng(seed)
    mean, covariance = random_means(rng, COUNT, towards), random_covariances(rng, COUNT)
    predictions = [GaussianStatePrediction(m, P, EPOCH) for m, P in zip(mean, covariance, strict=True)]
    shaken = mean[:, 0::2] + 20 * rng.standard_normal((COUNT, 3))
    value = np.stack([as_vector(model().function(state_at(place))) for place in shaken])
    return track_list(mean, covariance), predictions, value


def model():
    return components.measurement_model(PARAMS)


def state_at(place):
    state = np.zeros(6)
    state[0::2] = place
    return State(state)


def check_expected(ours, slot, theirs, prediction, tolerance=TOLERANCE):
    S, z = np.asarray(theirs.covar, float), as_vector(theirs.state_vector)
    assert mean_error(ours.mean[slot], z, S) <= tolerance
    assert covariance_error(ours.covariance[slot], S) <= tolerance
    sigmas = np.sqrt(np.diag(prediction.covar)), np.sqrt(np.diag(S))
    cross = np.asarray(theirs.cross_covar, float)
    assert cross_covariance_error(ours.cross_covariance[slot], cross, *sigmas) <= tolerance


@DIRECTIONS
@pytest.mark.parametrize("name", ["extended", "cubature"])
def test_expected_detection_and_posterior(name, towards):
    if name == "cubature" and towards is BEHIND:
        towards = (2.5, 0.1)  # Stone Soup's fails across the seam: see below
    tracks, predictions, value = scene(towards)
    parts = build_components(PARAMS, static=StaticParams(filter=name))
    expected = jax.jit(kalman.FILTERS[name])(tracks, PARAMS)
    updated = jax.jit(kalman.update)(tracks, expected, Detections.from_values(value), jnp.arange(COUNT))
    detections = to_detections(value, np.ones(COUNT, bool), 1, EPOCH, parts.measurement_model)
    for slot, (prediction, detection) in enumerate(zip(predictions, detections, strict=True)):
        theirs = parts.updater.predict_measurement(prediction, parts.measurement_model)
        check_expected(expected, slot, theirs, prediction)
        posterior = parts.updater.update(SingleHypothesis(prediction, detection))
        posterior = SimpleNamespace(state_vector=posterior.state_vector, covar=posterior.covar)
        moved = mean_error(posterior.state_vector, prediction.state_vector, posterior.covar)
        assert estimate_error(updated, slot, estimate(posterior)) <= TOLERANCE * max(1.0, moved)


@pytest.mark.parametrize("name", ["extended", "converted"])
def test_square_root_prediction_and_posterior(name):
    """`SqrtKalmanPredictor` and `SqrtKalmanUpdater` from the same factors."""
    tracks, predictions, value = scene(AHEAD)
    root = np.linalg.cholesky(tracks.covariance)
    parts = build_components(PARAMS, static=StaticParams(filter=name, covariance_form="square_root"))

    @jax.jit
    def play(tracks):
        predicted = kalman.predict(tracks, 1.0, PARAMS)
        expected, seen = kalman.FILTERS[name](predicted, PARAMS), Detections.from_values(value)
        if name == "converted":
            seen = converted.convert(seen, PARAMS)
            return predicted, converted.update(predicted, expected, seen, jnp.arange(COUNT))
        return predicted, kalman.update(predicted, expected, seen, jnp.arange(COUNT))

    predicted, updated = play(tracks.replace(root=jnp.asarray(root)))
    later = EPOCH + datetime.timedelta(seconds=1)
    detections = to_detections(value, np.ones(COUNT, bool), 1, later, parts.measurement_model)
    for slot, (prior, detection) in enumerate(zip(predictions, detections, strict=True)):
        start = SqrtGaussianStatePrediction(prior.state_vector, root[slot], EPOCH)
        theirs = parts.predictor.predict(start, timestamp=later)
        assert estimate_error(predicted, slot, estimate(theirs)) <= TOLERANCE
        seen = to_position(detection) if name == "converted" else detection
        posterior = parts.updater.update(SingleHypothesis(theirs, seen))
        moved = mean_error(posterior.state_vector, theirs.state_vector, posterior.covar)
        assert estimate_error(updated, slot, estimate(posterior)) <= TOLERANCE * max(1.0, moved)


def test_the_filters_differ():
    """By far more than the tolerance above: none of them can stand in for another."""
    tracks, *_ = scene(AHEAD)
    means = [np.asarray(kalman.FILTERS[name](tracks, PARAMS).mean[:, 2]) for name in list(kalman.FILTERS)[:3]]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(means[one] - means[other]).max() > 1e-6


@pytest.mark.parametrize("towards", [AHEAD, UP], ids=["ahead", "up"])
def test_the_bare_cubature_updater(towards):
    tracks, predictions, _ = scene(towards)
    expected = kalman.predict_detections_cubature(tracks, PARAMS)
    updater = CubatureKalmanUpdater(None)
    for slot, prediction in enumerate(predictions):
        theirs = updater.predict_measurement(prediction, model())
        check_expected(expected, slot, theirs, prediction, STOCK_CUBATURE_TOLERANCE)


def test_across_the_seam_of_bearings_stone_soups_cubature_fails_and_ours_does_not():
    """Its S has a negative variance there; ours is that of the same track turned by half a turn."""
    mean, covariance = np.array([[-3000.0, 10.0, 5.0, -20.0, 400.0, 5.0]]), 100.0 * np.eye(6)[None]
    half_turn = np.diag([-1.0, -1.0, -1.0, -1.0, 1.0, 1.0])
    stock = CubatureKalmanUpdater(None).predict_measurement(
        GaussianStatePrediction(mean[0], covariance[0], EPOCH), model()
    )
    assert stock.covar[1, 1] < 0
    ours = kalman.predict_detections_cubature(track_list(mean, covariance), PARAMS)
    turned = kalman.predict_detections_cubature(track_list(mean @ half_turn, covariance), PARAMS)
    # But for the small term that circular means leave, which grows with the bearing.
    assert covariance_error(ours.covariance, turned.covariance) <= 1e-4
    np.testing.assert_allclose(ours.mean[0, 1] - np.pi, turned.mean[0, 1], atol=1e-12)


@DIRECTIONS
def test_converted_detections(towards):
    """Position, noise, distance and posterior of every pair of track and detection."""
    tracks, predictions, value = scene(towards)
    parts = build_components(PARAMS, static=StaticParams(filter="converted"))
    expected = kalman.predict_positions(tracks, PARAMS)
    positions = jax.jit(converted.convert)(Detections.from_values(value), PARAMS)
    distances = converted.distances(expected, positions, MEASURES["mahalanobis"], PARAMS)
    detections = to_detections(value, np.ones(COUNT, bool), 1, EPOCH, parts.measurement_model)
    update = jax.jit(converted.update)
    for row, detection in enumerate(map(to_position, detections)):
        R = np.asarray(detection.measurement_model.covar(), float)
        assert mean_error(positions.value[row], as_vector(detection.state_vector), R) <= TOLERANCE
        assert covariance_error(positions.noise[row], R) <= TOLERANCE
        updated = update(tracks, expected, positions, jnp.full(COUNT, row))
        for slot in (row, (row + 1) % COUNT):
            theirs = parts.updater.predict_measurement(predictions[slot], detection.measurement_model)
            distance = Mahalanobis()(theirs, detection)
            assert distance_error(distances[slot, row], distance) <= TOLERANCE
            posterior = parts.updater.update(SingleHypothesis(predictions[slot], detection))
            posterior = SimpleNamespace(state_vector=posterior.state_vector, covar=posterior.covar)
            # A detection thousands of sigmas away moves the mean by thousands of sigmas.
            assert estimate_error(updated, slot, estimate(posterior)) <= TOLERANCE * max(1.0, distance)


@pytest.mark.parametrize("name", CONVERTED_MEASURES)
def test_measures_of_converted_detections(name):
    tracks, predictions, value = scene(AHEAD)
    expected = kalman.predict_positions(tracks, PARAMS)
    positions = converted.convert(Detections.from_values(value), PARAMS)
    distances = converted.distances(expected, positions, MEASURES[name], PARAMS)
    parts = build_components(PARAMS, static=StaticParams(filter="converted", measure=name))
    detections = to_detections(value, np.ones(COUNT, bool), 1, EPOCH, model())
    for row, detection in enumerate(map(to_position, detections[:5])):
        theirs = parts.updater.predict_measurement(predictions[row], detection.measurement_model)
        assert distance_error(distances[row, row], parts.measure(theirs, detection)) <= TOLERANCE


def test_a_converted_detection_starts_the_same_track():
    """Linear model with the detection's own noise, or the angles' model: one initial estimate."""
    _, _, value = scene(AHEAD)
    initiator = build_components(PARAMS).initiator
    for detection in to_detections(value[:5], np.ones(5, bool), 1, EPOCH, model()):
        (one,) = initiator.initiate({detection}, EPOCH)
        (other,) = initiator.initiate({to_position(detection)}, EPOCH)
        assert covariance_error(other.covar, one.covar) <= TOLERANCE
        assert mean_error(as_vector(other.state_vector), as_vector(one.state_vector), one.covar) <= TOLERANCE
        assert position_model(detection).mapping == (0, 2, 4)


def history(times, hits):
    """A Stone Soup track with a state at every time (microseconds), an update where it was hit."""
    states = []
    for time, hit in zip(times, hits, strict=True):
        stamp = EPOCH + datetime.timedelta(microseconds=int(time))
        kind = {True: Detection(np.zeros(3), timestamp=stamp), False: None}[bool(hit)]
        prediction = GaussianStatePrediction(np.zeros(6), np.eye(6), stamp)
        if hit:
            hypothesis = SingleHypothesis(prediction, kind)
            states.append(Update.from_state(prediction, hypothesis=hypothesis, timestamp=stamp))
        else:
            states.append(prediction)
    return Track(states)


@pytest.mark.parametrize("limit", [1, 2, 3, 5])
def test_deleters_by_time(limit):
    """Random histories with repeated times and with sums of steps exactly at the limit."""
    rng = np.random.default_rng(limit)
    decided = {"update_time": [], "update_time_steps": []}
    for _ in range(60):
        length = int(rng.integers(1, 9))
        steps = rng.choice([0.0, 0.1, 0.2, 0.3], length)
        hits = rng.random(length) < 0.3
        hits[0] = True
        params = Params(deletion_time=0.1 * limit, deletion_steps=limit)
        counts = Counts.zero(1).initiated(jnp.array([True]))
        for step, hit in zip(steps[1:], hits[1:], strict=True):
            counts = counts.predicted(step).updated(jnp.array([hit]))
        times = np.cumsum(np.round(MICROSECONDS * np.concatenate([[0], steps[1:]])))
        track = history(times, hits)
        tracks = track_list(np.ones((1, 6)), np.eye(6)[None]).replace(counts=counts)
        assert counts.hits[0] == hits.sum()
        for name, found in decided.items():
            ours = bool(lifecycle.DELETERS[name](tracks, params)[0])
            assert ours == components.DELETERS[name](params).check_for_deletion(track), (name, times, hits)
            found.append(ours)
    assert all(0 < sum(found) < len(found) for found in decided.values())


def test_scenarios_have_what_their_parts_need():
    for part in PARTS:
        scenario = scenario_for(part, 0, 20)
        assert ("update_time" in part.static.deleters) == (scenario.params.deletion_time is not None)
        assert ("update_time_steps" in part.static.deleters) == (scenario.params.deletion_steps is not None)
        assert scenario.kind in part.kinds


CUBATURE = next(part for part in PARTS if part.component == "kalman.predict_detections_cubature")


def test_a_long_cubature_episode_keeps_its_digits():
    """A crowd at 11 km seen every 16 ms, whose tracks are updated dozens of times."""
    scenario = scenario_for(CUBATURE, 43, 50)
    records = run(Job(scenario, static=CUBATURE.static))
    found = compare(scenario, records, True, TOLERANCE, CUBATURE.static)
    assert (found.steps, found.divergence, found.indefinite) == (50, None, False)
    assert found.error < 1e-10


LOST, LOST_ON = (37, 0), 39
"""A new track at 1.1 km, 72 degrees high, whose first update leaves it an indefinite covariance."""


@pytest.fixture(scope="module")
def indefinite():
    """The scenario and both sides' episode."""
    scenario = scenario_for(CUBATURE, 12, 50)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Stone Soup, as it goes on from there
        records = run(Job(scenario, static=CUBATURE.static))
    return scenario, records, *episode(scenario, static=CUBATURE.static)


def compare_indefinite(scenario, records, tracks, info, static=CUBATURE.static):
    active = scenario.detections.active
    return compare_episode(records, tracks, info, active, scenario.params, TOLERANCE, static)


def with_live(records, step, **fields):
    """The records with another estimate of the track at the end of a step."""
    record = records[step - 1]
    live = {**record.live, LOST: dataclasses.replace(record.live[LOST], **fields)}
    return [*records[: step - 1], dataclasses.replace(record, live=live), *records[step:]]


def test_an_episode_ends_where_both_sides_have_the_same_indefinite_covariance(indefinite):
    _, records, tracks, info = indefinite
    found = compare_indefinite(*indefinite)
    assert (found.steps, found.divergence, found.indefinite, found.tie) == (LOST_ON, None, True, False)
    assert np.linalg.eigvalsh(records[LOST_ON - 1].live[LOST].covariance).min() < 0
    # From there on ours has no numbers.
    slot = list(zip(tracks.birth_step[LOST_ON], tracks.birth_detection[LOST_ON], strict=True)).index(LOST)
    assert np.isnan(info.distances[LOST_ON, slot]).all()
    tallies = EpisodeTallies()
    assert tallies.note("what else", "") == "what else"
    tallies.add(12, found)
    assert tallies.note("what else").startswith("what else; episodes that end early, with a covariance")
    assert tallies.note().endswith(": 1")


def test_an_indefinite_covariance_excuses_nothing_else(indefinite):
    scenario, records, tracks, info = indefinite
    # Where no factors are needed.
    found = compare_indefinite(*indefinite, static=StaticParams(filter="extended"))
    assert not found.indefinite
    assert found.divergence.step > LOST_ON
    # Before it.
    estimate = records[LOST_ON - 1].live[LOST]
    wrong = with_live(records, LOST_ON, mean=estimate.mean + 0.1)
    found = compare_indefinite(scenario, wrong, tracks, info)
    assert (found.divergence.step, found.divergence.track, found.indefinite) == (LOST_ON, LOST, False)
    # Ours alone.
    sound = with_live(records, LOST_ON, covariance=np.diag(np.diag(estimate.covariance)))
    found = compare_indefinite(scenario, sound, tracks, info)
    assert (found.divergence.step, found.divergence.track, found.indefinite) == (LOST_ON, LOST, False)


def test_both_environments_with_other_parts():
    static = StaticParams(
        num_truths=12,
        max_tracks=40,
        max_detections=20,
        map_size=12,
        filter="converted",
        associator="global_nearest_neighbour",
        deleters=("covariance", "update_time_steps"),
        initiator="multi_measurement",
    )
    tallies = EnvironmentTallies()
    params = LIVELY.replace(deletion_steps=40)
    divergence = compare_environment(static, params, 3, 80, TOLERANCE, tallies)
    assert divergence is None, str(divergence)
    assert tallies.seen.compared == 80 * 4
