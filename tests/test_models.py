"""Motion and measurement models against hand values and against each other's inverse."""

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxtrack import models

DEGREE = np.pi / 180
angles = st.floats(-20.0, 20.0)
wrap_bearing = jax.jit(models.wrap_bearing)
fold_elevation = jax.jit(models.fold_elevation)
measure = jax.jit(models.elevation_bearing_range)
measure_points = jax.jit(models.spherical)


@jax.jit
def spherical_offsets(centre, displacement):
    """Sines `[K, 2]`, cosines `[K, 2]` and ranges `[K]` of displacements `[K, 3]`."""
    changes = models.spherical_offsets(centre, jnp.moveaxis(displacement, -1, 0))
    return jnp.stack(changes[:4:2], axis=-1), jnp.stack(changes[1:4:2], axis=-1), changes[4]


locate = jax.jit(models.inverse_elevation_bearing_range)
inverse_jacobian = jax.jit(models.inverse_jacobian)


def test_constant_velocity_by_hand():
    F, Q = models.constant_velocity(2.0, 3.0)
    for axis in range(3):
        block = slice(2 * axis, 2 * axis + 2)
        np.testing.assert_allclose(F[block, block], [[1, 2], [0, 1]], rtol=1e-6)
        # q dt^3/3 = 3 * 8/3, q dt^2/2 = 3 * 2, q dt = 3 * 2
        np.testing.assert_allclose(Q[block, block], [[8, 6], [6, 6]], rtol=1e-6)
    # Nothing couples the axes: all the rest is zero.
    assert jnp.count_nonzero(F) == 9
    assert jnp.count_nonzero(Q) == 12


def test_two_half_steps_of_motion_are_one_whole_step(x64):
    F, Q = models.constant_velocity(0.7, 2.0)
    half_F, half_Q = models.constant_velocity(0.35, 2.0)
    np.testing.assert_allclose(half_F @ half_F, F, rtol=1e-14)
    np.testing.assert_allclose(half_F @ half_Q @ half_F.T + half_Q, Q, rtol=1e-13)


@pytest.mark.parametrize(
    ("angle", "expected"),
    [(0, 0), (90, 90), (179, 179), (180, -180), (-180, -180), (181, -179), (-190, 170), (725, 5)],
)
def test_bearings_wrap_to_half_open_circle(angle, expected, x64):
    np.testing.assert_allclose(wrap_bearing(angle * DEGREE), expected * DEGREE, atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "expected"),
    [(0, 0), (89, 89), (90, 90), (-90, -90), (100, 80), (-100, -80), (190, -10), (-170, -10), (365, 5)],
)
def test_elevations_fold_over_the_zenith(angle, expected, x64):
    np.testing.assert_allclose(fold_elevation(angle * DEGREE), expected * DEGREE, atol=1e-12)


@given(angles)
def test_wrapped_bearings_point_the_same_way(x64, angle):
    wrapped = wrap_bearing(angle)
    assert -np.pi - 1e-12 <= wrapped <= np.pi + 1e-12
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-12)


@given(angles)
def test_folded_elevations_are_equally_high(x64, angle):
    folded = fold_elevation(angle)
    assert abs(folded) <= np.pi / 2 + 1e-12
    np.testing.assert_allclose(np.sin(folded), np.sin(angle), atol=1e-12)


def test_a_detection_folds_elevation_wraps_bearing_and_keeps_range():
    value = jnp.array([[100 * DEGREE, 190 * DEGREE, 7.0], [0.1, -0.2, -7.0]])
    expected = [[80 * DEGREE, -170 * DEGREE, 7.0], [0.1, -0.2, -7.0]]
    np.testing.assert_allclose(models.wrap_detection(value), expected, rtol=1e-5)


def test_elevation_bearing_range_by_hand():
    state = jnp.array([3.0, -1.0, 4.0, -2.0, 12.0, -3.0])  # velocities must not matter
    expected = [np.arctan(12 / 5), np.arctan(4 / 3), 13.0]
    np.testing.assert_allclose(measure(state), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("point", "elevation", "bearing"),
    [
        ([1, 0, 0], 0, 0),
        ([0, 2, 0], 0, 90),
        ([0, -2, 0], 0, -90),
        ([1, 0, -1], -45, 0),
        ([-1, -1, 0], 0, -135),
    ],
)
def test_up_is_positive_elevation_and_left_is_positive_bearing(point, elevation, bearing):
    measured = models.spherical(jnp.array(point, dtype=float))
    np.testing.assert_allclose(measured[:2], [elevation * DEGREE, bearing * DEGREE], rtol=1e-6)
    unit = point / np.linalg.norm(point)
    np.testing.assert_allclose(models.direction(measured[1], measured[0]), unit, atol=1e-6)


@given(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(10.0, 1e5))
def test_measuring_the_located_detection_gives_it_back(x64, elevation, bearing, distance):
    detection = jnp.array([elevation, bearing, distance])
    state = jnp.zeros(6).at[0::2].set(locate(detection))
    np.testing.assert_allclose(measure(state), detection, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("detection", [[0.3, 0.7, 3000.0], [-1.0, -3.0, 900.0], [0.0, 0.0, 10.0]])
def test_the_inverse_jacobian_against_finite_differences(detection, x64):
    detection = np.array(detection)
    columns = []
    for axis, step in enumerate([1e-6, 1e-6, 1e-3]):
        offset = step * np.eye(3)[axis]
        columns.append((locate(detection + offset) - locate(detection - offset)) / (2 * step))
    np.testing.assert_allclose(
        inverse_jacobian(jnp.asarray(detection)), np.stack(columns, axis=-1), rtol=1e-7, atol=1e-5
    )


def test_the_inverse_jacobian_inverts_the_jacobian_of_the_measurement(x64):
    detection = jnp.array([0.4, -0.9, 2500.0])
    forward = jax.jacfwd(models.spherical)(locate(detection))
    np.testing.assert_allclose(forward @ inverse_jacobian(detection), np.eye(3), atol=1e-12)


@given(
    hnp.arrays(float, 3, elements=st.floats(-3000, 3000)),
    hnp.arrays(float, (4, 3), elements=st.floats(-500, 500)),
)
def test_offsets_are_the_differences_of_two_measurements(x64, centre, displacement):
    centre = centre + np.array([2000.0, 0, 0]) * np.sign(centre[0] + 0.5)
    sine, cosine, range_change = spherical_offsets(centre, displacement)
    change = measure_points(centre + displacement) - measure_points(centre)
    np.testing.assert_allclose(sine, np.sin(change[:, :2]), atol=1e-11)
    np.testing.assert_allclose(cosine, np.cos(change[:, :2]), atol=1e-11)
    np.testing.assert_allclose(range_change, change[:, 2], atol=1e-8)


def test_offsets_do_not_cancel_in_single_precision():
    # A centimetre at five kilometres is 2 microradians, below the spacing of angles near 1 rad.
    centre, displacement = np.array([3000.0, 4000.0, 0.0]), np.array([[-0.008, 0.006, 0.01]])
    sine, _, range_change = spherical_offsets(jnp.asarray(centre), jnp.asarray(displacement))
    np.testing.assert_allclose(sine, [[2e-6, 2e-6]], rtol=1e-3)
    # |d|^2 / (2 r): the displacement is square to the line of sight.
    np.testing.assert_allclose(range_change, [2e-8], atol=2e-9)


def test_arctan2_in_single_precision_is_good_to_two_units_in_the_last_place():
    angle = np.linspace(-np.pi, np.pi, 20_001)
    size = 10.0 ** np.random.default_rng(0).uniform(-10, 10, angle.shape)
    y, x = (np.float32(size * part) for part in (np.sin(angle), np.cos(angle)))
    found = jax.jit(models.arctan2)(jnp.asarray(y), jnp.asarray(x))
    exact = np.arctan2(y.astype(float), x.astype(float))
    assert np.max(np.abs(found - exact) / np.spacing(np.abs(np.float32(exact)))) <= 2


@pytest.mark.parametrize("y", [-1.0, -0.0, 0.0, 1.0])
@pytest.mark.parametrize("x", [-2.0, 0.0, 2.0])
def test_arctan2_on_the_axes(x, y):
    found = models.arctan2(jnp.asarray([y], jnp.float32), jnp.asarray([x], jnp.float32))
    np.testing.assert_allclose(found, np.arctan2(np.float32([y]), np.float32([x])), rtol=2e-7)
    assert np.signbit(found[0]) == np.signbit(np.arctan2(y, x))


def exact_less_sine(angle):
    """``angle - sin(angle)`` by its series in fractions."""
    x = Fraction(float(angle))
    return float(sum((-1) ** (n + 1) * x ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(1, 20)))


@pytest.mark.parametrize(("dtype", "within"), [(np.float64, 2e-14), (np.float32, 1e-5)])
def test_an_angle_less_its_sine_keeps_its_digits(x64, dtype, within):
    """In both branches, and on both sides of where they meet."""
    sizes = np.concatenate([np.geomspace(1e-8, 3.1, 60), [0.5, np.nextafter(0.5, 0)]])
    angle = np.concatenate([sizes, -sizes]).astype(dtype)
    found = jax.jit(models.less_sine)(jnp.asarray(angle))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, [exact_less_sine(x) for x in angle], rtol=within)
    assert models.less_sine(jnp.zeros(1))[0] == 0
