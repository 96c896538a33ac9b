"""The steerable radar: looks, beam, detections and their order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Params, StaticParams, sensor
from jaxtrack.episode import sample_step_noise
from jaxtrack.sensor import SensorNoise
from jaxtrack.types import NO_TRUTH

DEGREE = np.pi / 180
LIMIT = Params().field_limit
AHEAD = jnp.zeros(2)
in_beam = jax.jit(sensor.in_beam)
detect = jax.jit(sensor.detect, static_argnums=3)


def towards(azimuth, elevation, distance=1.0):
    """Point at angles in degrees, by the textbook formula."""
    az, el = azimuth * DEGREE, elevation * DEGREE
    return distance * jnp.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])


def quiet(static, **draws):
    """Draws that add nothing: no measurement noise, every truth detected, no clutter."""
    silence = {
        "detection": jnp.zeros((static.num_truths, 3)),
        "detected": jnp.zeros(static.num_truths),
        "clutter_count": jnp.asarray(0.0),
        "clutter": jnp.full((static.max_clutter, 3), 0.5),
    }
    return SensorNoise(**(silence | {name: jnp.asarray(draw, float) for name, draw in draws.items()}))


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ([0, 0], [-60, -60]),
        ([18, 18], [60, 60]),
        ([0, 18], [-60, 60]),
        ([9, 9], [0, 0]),
        ([10, 8], [20 / 3, -20 / 3]),
        ([-3, 25], [-60, 60]),
    ],
)
def test_discrete_looks_at_corners_centre_and_beyond(action, expected, params):
    angles = sensor.look_angles(jnp.array(action), StaticParams(), params)
    np.testing.assert_allclose(angles / DEGREE, expected, atol=1e-4)


def test_continuous_looks_are_angles_kept_within_the_field(params):
    static = StaticParams(continuous_actions=True)
    actions = jnp.array([[0.1, -0.2], [2.0, -2.0], [jnp.inf, -jnp.inf]])
    expected = [[0.1, -0.2], [LIMIT, -LIMIT], [LIMIT, -LIMIT]]
    np.testing.assert_allclose(sensor.look_angles(actions, static, params), expected, rtol=1e-6)


def test_the_look_of_an_angle_is_the_nearest_one(params):
    static = StaticParams()
    every = jnp.stack(jnp.meshgrid(jnp.arange(19), jnp.arange(19)), axis=-1)
    angles = sensor.look_angles(every, static, params)
    near = 0.49 * (2 * LIMIT / 18)
    for shift in (0.0, near, -near):
        np.testing.assert_array_equal(sensor.look_indices(angles + shift, static, params), every)
    beyond = jnp.array([[-90, 90], [0, 120]]) * DEGREE
    np.testing.assert_array_equal(sensor.look_indices(beyond, static, params), [[0, 18], [9, 18]])


def test_a_nan_angle_looks_nowhere(params):
    static = StaticParams(continuous_actions=True)
    look = sensor.look_angles(jnp.array([jnp.nan, 0.0]), static, params)
    assert not bool(in_beam(towards(0, 0), look, params))


def test_the_boresight_lies_along_x():
    look = jnp.array([35.0, -20.0]) * DEGREE
    np.testing.assert_allclose(sensor.boresight_frame(towards(35, -20), look), [1, 0, 0], atol=1e-6)
    # A point to the left of and a point above the boresight.
    np.testing.assert_allclose(sensor.boresight_frame(towards(125, 0), look), [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(sensor.boresight_frame(towards(35, 70), look), [0, 0, 1], atol=1e-6)


def test_the_platform_frame_undoes_the_boresight_frame():
    points = jax.random.normal(jax.random.key(0), (10, 3))
    look = jnp.array([0.7, -0.4])
    there = sensor.boresight_frame(points, look)
    np.testing.assert_allclose(jnp.linalg.norm(there, axis=-1), jnp.linalg.norm(points, axis=-1), rtol=1e-5)
    np.testing.assert_allclose(sensor.platform_frame(there, look), points, atol=1e-5)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "seen"),
    [
        (0, 0, True),
        (4.4999, 0, True),
        (4.5001, 0, False),
        (-4.4999, 0, True),
        (-4.5001, 0, False),
        (0, 4.4999, True),
        (0, 4.5001, False),
        (0, -4.4999, True),
        (0, -4.5001, False),
        (4.4999, 4.4999, True),
        (180, 0, False),
        (176, 0, False),
    ],
)
@pytest.mark.parametrize("distance", [1.0, 1e4])
def test_the_beam_ahead_is_nine_degrees_wide(azimuth, elevation, seen, distance, params, x64):
    assert bool(in_beam(towards(azimuth, elevation, distance), AHEAD, params)) == seen


def test_the_beams_edges_are_included():
    # The edges of a beam without width are exact in floating point.
    assert bool(in_beam(jnp.array([1.0, 0, 0]), AHEAD, Params(beam_azimuth=0.0)))
    assert bool(in_beam(jnp.array([1.0, 0, 0]), AHEAD, Params(beam_elevation=0.0)))


def test_azimuth_and_elevation_widths_are_not_mistaken():
    wide = Params(beam_azimuth=20 * DEGREE, beam_elevation=2 * DEGREE)
    assert bool(in_beam(towards(9, 0), AHEAD, wide))
    assert not bool(in_beam(towards(0, 9), AHEAD, wide))


@pytest.mark.parametrize(("azimuth", "seen"), [(6.9, True), (7.1, False), (-6.9, True), (-7.1, False)])
def test_high_up_the_beam_covers_more_azimuth(azimuth, seen, params):
    # At elevation 50 the boresight bearing of a target delta degrees of azimuth away is
    # atan2(cos 50 sin delta, cos^2 50 cos delta + sin^2 50): 4.43 for 6.9, 4.56 for 7.1.
    look = jnp.array([30.0, 50.0]) * DEGREE
    assert bool(in_beam(towards(30 + azimuth, 50), look, params)) == seen


def test_detections_come_in_the_order_of_the_truths_then_clutter(truths_at, static):
    params = Params(clutter_rate=1.0)
    truths = truths_at([towards(2, 1, 3000), towards(30, 0, 2000), towards(-1, 2, 5000)])
    # exp(-1) = 0.37 <= 0.5 < 2 exp(-1) = 0.74: one false detection, in the middle of the beam.
    noise = quiet(static, clutter_count=0.5)
    detections, dropped = detect(truths, AHEAD, noise, static, params)
    np.testing.assert_array_equal(detections.active, [True, True, True, False])
    np.testing.assert_array_equal(detections.truth, [0, 2, NO_TRUTH, NO_TRUTH])
    expected = [[DEGREE, 2 * DEGREE, 3000], [2 * DEGREE, -DEGREE, 5000], [0, 0, 5500], [0, 0, 0]]
    np.testing.assert_allclose(detections.value, expected, rtol=1e-5, atol=1e-6)
    assert int(dropped) == 0
    assert NO_TRUTH == NO_DETECTION == -1


def test_noise_is_scaled_by_each_sigma_and_absent_truths_are_not_seen(truths_at, static):
    params = Params(elevation_sigma=1e-3, bearing_sigma=4e-3, range_sigma=7.0)
    truths = truths_at([towards(0, 0, 3000)] * 3, alive=[True, False, True])
    noise = quiet(static, detection=[[1, 2, 3], [0, 0, 0], [-1, -2, -3]])
    detections, _ = detect(truths, AHEAD, noise, static, params)
    np.testing.assert_array_equal(detections.truth, [0, 2, NO_TRUTH, NO_TRUTH])
    expected = [[1e-3, 8e-3, 3021], [-1e-3, -8e-3, 2979]]
    np.testing.assert_allclose(detections.value[:2], expected, rtol=1e-5, atol=1e-7)


def test_noise_across_the_rear_wraps_the_bearing(truths_at, static, params):
    noise = quiet(static, detection=np.tile([0.0, 1.0, 0.0], (3, 1)))
    detections, _ = detect(truths_at([[-1e3, 0, 0]] * 3), jnp.array([np.pi, 0]), noise, static, params)
    np.testing.assert_allclose(detections.value[:3, 1], -np.pi + 2e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("probability", "seen"), [(0.0, []), (0.5, [0]), (0.50001, [0, 1]), (1.0, [0, 1, 2])]
)
def test_a_truth_is_detected_if_its_draw_is_below_the_probability(probability, seen, truths_at, static):
    params = Params(detection_probability=probability)
    noise = quiet(static, detected=[0.2, 0.5, 0.999])
    detections, _ = detect(truths_at([towards(0, 0, 3000)] * 3), AHEAD, noise, static, params)
    assert detections.truth[detections.active].tolist() == seen


def test_what_finds_no_slot_is_counted(truths_at):
    static = StaticParams(num_truths=3, max_detections=2, max_clutter=2)
    truths = truths_at([towards(0, 0, 3000)] * 3)
    detections, dropped = detect(truths, AHEAD, quiet(static), static, Params())
    np.testing.assert_array_equal(detections.truth, [0, 1])
    assert int(dropped) == 1
    # Rate 2: P(n <= 4) = 0.947 <= 0.95 < P(n <= 5): five false ones, two of which may be.
    noise = quiet(static, clutter_count=0.95)
    detections, dropped = detect(truths, AHEAD, noise, static, Params(clutter_rate=2.0))
    np.testing.assert_array_equal(detections.truth, [0, 1])
    assert int(dropped) == 1 + 5


def test_an_empty_beam_returns_nothing(truths_at, static, params):
    detections, dropped = detect(truths_at([towards(30, 0, 3000)] * 3), AHEAD, quiet(static), static, params)
    assert not bool(jnp.any(detections.active))
    np.testing.assert_array_equal(detections.value, np.zeros((4, 3)))
    assert int(dropped) == 0


def test_draws_have_their_laws_and_depend_on_the_key():
    static = StaticParams(num_truths=2000, max_clutter=700)
    sample = jax.jit(sample_step_noise, static_argnums=1)
    noise, other = (sample(jax.random.key(seed), static).sensor for seed in (0, 1))
    np.testing.assert_allclose(np.cov(np.asarray(noise.detection).T), np.eye(3), atol=0.16)
    for uniform in (noise.detected, noise.clutter):
        assert np.all((uniform >= 0) & (uniform < 1))
        # Standard error of the mean of 2000 uniforms is 0.0065.
        assert abs(np.mean(uniform) - 0.5) < 0.033
    assert noise.clutter.shape == (700, 3)
    assert noise.clutter_count.shape == ()
    assert not np.any(np.asarray(noise.detected) == np.asarray(other.detected))
    assert abs(np.corrcoef(noise.detected, noise.detection[:, 0])[0, 1]) < 0.11
