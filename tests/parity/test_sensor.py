"""`sensor` against RadarRotatingElevationBearingRange and its boresight frame."""

import datetime

import jax
import numpy as np
import pytest
from stonesoup.sensor.radar.radar import RadarRotatingElevationBearingRange
from stonesoup.types.groundtruth import GroundTruthState

from jaxtrack import Params, StaticParams, Truths, models, sensor
from jaxtrack.episode import sample_step_noise
from reference.components import measurement_model
from reference.parity.scenes import unit_vectors
from reference.radar import build_radar, steer
from reference.translate import as_vector

NOW = datetime.datetime(2000, 1, 1)
IN_BEAM = jax.jit(sensor.in_beam)
DETECT = jax.jit(sensor.detect, static_argnums=3)
LOOKS = [(0.0, 0.0), (0.7, -0.4), (-1.04, 1.04), (3.1, 0.2), (0.3, 1.5)]
EDGE = 1e-9  # rad


def radar_at(look, params):
    radar = build_radar(params, RadarRotatingElevationBearingRange)
    steer(radar, *look)
    return radar


def at(points):
    """Ground truth states at rest at points `[N, 3]`."""
    states = np.zeros((len(points), 6))
    states[:, 0::2] = points
    return states


def stone_soup_sees(states, radar):
    model = radar.measurement_model
    return [radar.is_detectable(GroundTruthState(state, timestamp=NOW), model) for state in states]


@pytest.mark.parametrize("look", LOOKS)
def test_field_of_view(look):
    """Random points, most of them close to the beam's border, and some behind the radar."""
    rng = np.random.default_rng(1)
    params = Params(beam_azimuth=0.2, beam_elevation=0.1)
    bearing, elevation = rng.uniform(-0.2, 0.2, 400), rng.uniform(-0.1, 0.1, 400)
    points = 3000.0 * unit_vectors(bearing, elevation)
    points[:50] *= -1
    points = np.asarray(sensor.platform_frame(points, np.array(look)))
    theirs = stone_soup_sees(at(points), radar_at(look, params))
    np.testing.assert_array_equal(IN_BEAM(points, np.array(look), params), theirs)
    assert 50 < sum(theirs) < 350


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("nudge", [-EDGE, EDGE], ids=["inside", "outside"])
def test_edges_of_the_field_of_view(look, nudge):
    """A billionth of a radian from every edge and corner, in the boresight frame."""
    params = Params(beam_azimuth=0.2, beam_elevation=0.1)
    side = np.array([(b, e) for b in (-1, 0, 1) for e in (-1, 0, 1) if (b, e) != (0, 0)])
    bearing = side[:, 0] * (params.beam_azimuth / 2 + nudge)
    elevation = side[:, 1] * (params.beam_elevation / 2 + nudge)
    points = np.asarray(sensor.platform_frame(5000.0 * unit_vectors(bearing, elevation), np.array(look)))
    theirs = stone_soup_sees(at(points), radar_at(look, params))
    np.testing.assert_array_equal(IN_BEAM(points, np.array(look), params), theirs)
    assert theirs == [nudge < 0] * len(side)


@pytest.mark.parametrize("axis", ["beam_azimuth", "beam_elevation"])
def test_edges_are_inside(axis):
    """A beam without width sees what is exactly on its boresight: only there is it exact."""
    params = Params(**{axis: 0.0})
    points = np.array([[1000.0, 0.0, 0.0]])
    theirs = stone_soup_sees(at(points), radar_at((0.0, 0.0), params))
    np.testing.assert_array_equal(IN_BEAM(points, np.zeros(2), params), theirs)
    assert theirs == [True]


@pytest.mark.parametrize("look", LOOKS)
def test_boresight_frame(look):
    """The rotation of Stone Soup's measurement model, and its inverse."""
    points = 1000.0 * np.random.default_rng(2).standard_normal((40, 3))
    model = radar_at(look, Params()).measurement_model
    turned = sensor.boresight_frame(points, np.array(look))
    np.testing.assert_allclose(turned, points @ model.rotation_matrix.T, atol=1e-9)
    np.testing.assert_allclose(sensor.platform_frame(turned, np.array(look)), points, atol=1e-9)


def quiet_look(static):
    noise = sample_step_noise(jax.random.key(0), static).sensor
    return noise.replace(detection=0 * noise.detection, detected=0 * noise.detected)


@pytest.mark.parametrize("look", LOOKS)
def test_noise_free_detections(look):
    """Same truths seen; the radar's boresight detection and our platform one are one place."""
    rng = np.random.default_rng(3)
    static, params = StaticParams(num_truths=12, max_detections=12), Params()
    angles = rng.uniform(-0.12, 0.12, (12, 2))
    points = rng.uniform(500.0, 9000.0, (12, 1)) * unit_vectors(angles[:, 0], angles[:, 1])
    states = at(np.asarray(sensor.platform_frame(points, np.array(look))))
    truths = [GroundTruthState(state, timestamp=NOW) for state in states]
    radar = radar_at(look, params)
    theirs = {id(found.groundtruth_path): found for found in radar.measure(set(truths), noise=False)}

    alive = Truths(states, np.ones(12, dtype=bool))
    ours, num_dropped = DETECT(alive, np.array(look), quiet_look(static), static, params)
    seen = np.asarray(ours.truth)[np.asarray(ours.active)]
    assert num_dropped == 0
    assert {id(truths[row]) for row in seen} == theirs.keys()
    assert 0 < len(theirs) < 12
    for row, truth in enumerate(seen):
        found = theirs[id(truths[truth])]
        place = as_vector(radar.measurement_model.inverse_function(found))[0::2]
        np.testing.assert_allclose(models.inverse_elevation_bearing_range(ours.value[row]), place, atol=1e-8)
        direct = as_vector(measurement_model(params).function(truths[truth]))
        np.testing.assert_allclose(ours.value[row], direct, rtol=1e-12)
