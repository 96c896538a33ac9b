"""The square-root form: the same filter in other arithmetic, sound in float32 where the full form is not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, StaticParams, converted, kalman, lifecycle, tracker
from jaxtrack.models import constant_velocity, elevation_bearing_range
from jaxtrack.params import FILTERS
from jaxtrack.square_root import Factors, initial_root, predict_root, square, update_root
from jaxtrack.unscented import cubature

pytestmark = pytest.mark.usefixtures("quick_compilation")

PARAMS = Params(time_step=0.5, process_noise=2.0)
MEANS = np.array([[3000.0, 10, 900, -5, 1200, 3], [-2000, 0, 5, 40, -600, 9], [1500, -7, -1500, 1, 20, 4]])
COUNT = len(MEANS)


def random_roots(seed, rows=6, columns=6):
    return np.random.default_rng(seed).normal(size=(COUNT, rows, columns))


def lists(root, filter="unscented"):
    """The same tracks in both forms, and the filter's counterpart for the full one."""
    full = lifecycle.no_tracks(COUNT, StaticParams(filter=filter)).replace(
        mean=jnp.asarray(MEANS), covariance=square(root), active=jnp.ones(COUNT, bool)
    )
    return full, full.replace(root=jnp.asarray(root))


def follow(name, both, seen, params):
    """Some steps of a filter in both forms with the same detections, the last track's always missed."""

    def step(tracks, value):
        # The cubature filter's square root leaves out what circular means leave.
        textbook = name == "cubature" and tracks.root is None
        own = cubature(params) if textbook else params
        expect = kalman.FILTERS["unscented" if textbook else name]
        predicted = kalman.predict(tracks, params.time_step, params)
        expected, detections = expect(predicted, own), Detections.from_values(value)
        associated = jnp.array([0, 1, NO_DETECTION])
        if name == "converted":
            positions = converted.convert(detections, params)
            tracks = converted.update(predicted, expected, positions, associated)
        else:
            tracks = kalman.update(predicted, expected, detections, associated)
        return tracks, (expected.replace(factors=None), predicted, tracks)

    play = jax.jit(lambda both: [jax.lax.scan(step, tracks, seen)[1] for tracks in both])
    return jax.device_get(play(both))


def detections(steps, sigmas=(2e-3, 2e-3, 5.0)):
    places = elevation_bearing_range(jnp.asarray(MEANS))
    return places + np.random.default_rng(5).normal(size=(steps, COUNT, 3)) * np.asarray(sigmas)


def check_same(one, other):
    """Means and covariances to 1e-9 sigma."""
    sigma = np.sqrt(np.diagonal(one.covariance, axis1=-2, axis2=-1))
    np.testing.assert_allclose((other.mean - one.mean) / sigma, 0, atol=1e-9)
    scale = sigma[..., :, None] * sigma[..., None, :]
    np.testing.assert_allclose((other.covariance - one.covariance) / scale, 0, atol=1e-9)
    return sigma


@pytest.mark.parametrize("name", FILTERS)
def test_both_forms_are_the_same_filter_in_float64(x64, name):
    """Every prediction, expectation and update; a track without a detection too."""
    root = random_roots(1) * np.array([30.0, 8.0] * 3)[:, None]
    full, factored = follow(name, lists(root, name), detections(8), PARAMS)
    sigma_detection, sigma, _ = (check_same(*pair) for pair in zip(full, factored, strict=True))
    difference = factored[0].cross_covariance - full[0].cross_covariance
    scale = sigma[..., :, None] * sigma_detection[..., None, :]
    np.testing.assert_allclose(difference / scale, 0, atol=1e-9)


def test_prediction_is_the_textbooks(x64):
    root = random_roots(2)
    F, Q = (np.asarray(matrix) for matrix in constant_velocity(0.7, 3.0))
    predicted = np.asarray(jax.jit(predict_root)(root, 0.7, Params(process_noise=3.0)))
    np.testing.assert_array_equal(predicted, np.tril(predicted))
    for L, before in zip(predicted, root, strict=True):
        np.testing.assert_allclose(L @ L.T, F @ before @ before.T @ F.T + Q, rtol=1e-12, atol=1e-12)


def test_update_is_the_textbooks(x64):
    L, G, N, innovation = random_roots(3), random_roots(4, 3), random_roots(5, 3, 3), random_roots(6, 3, 1)
    factors = Factors(jnp.asarray(G), jnp.asarray(N))
    change, updated = map(np.asarray, jax.jit(update_root)(L, factors, innovation[..., 0]))
    for row in range(COUNT):
        S, C = G[row] @ G[row].T + N[row] @ N[row].T, L[row] @ G[row].T
        np.testing.assert_allclose(factors.covariance()[row], S, rtol=1e-12)
        np.testing.assert_allclose(factors.cross_covariance(jnp.asarray(L))[row], C, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(change[row], C @ np.linalg.solve(S, innovation[row, :, 0]), rtol=1e-9)
        expected = L[row] @ L[row].T - C @ np.linalg.solve(S, C.T)
        np.testing.assert_allclose(updated[row] @ updated[row].T, expected, rtol=1e-8, atol=1e-10)
        np.testing.assert_array_equal(updated[row], np.tril(updated[row]))


def test_new_tracks_begin_with_the_same_covariance(x64):
    value = elevation_bearing_range(jnp.asarray(MEANS))
    _, covariance = lifecycle.initial_estimate(value, PARAMS)
    np.testing.assert_allclose(square(initial_root(value, PARAMS)), covariance, rtol=1e-12, atol=1e-9)


SHARP = dataclasses.replace(
    PARAMS, time_step=0.1, elevation_sigma=1e-6, bearing_sigma=1e-6, range_sigma=1.0, process_noise=1e-2
)


def test_in_float32_no_variance_is_negative_where_the_full_form_breaks():
    """Angles known to 1e-6, velocities at first to 1e6 m/s."""
    sigmas = (SHARP.elevation_sigma, SHARP.bearing_sigma, SHARP.range_sigma)
    name, root = "unscented", jnp.diag(jnp.array([1e-3, 1e6] * 3)) * jnp.ones((COUNT, 1, 1))
    full, factored = (
        tracks.covariance[:, :2]
        for _, _, tracks in follow(name, lists(root, name), detections(30, sigmas), SHARP)
    )
    assert factored.dtype == np.float32
    assert not np.all(np.diagonal(full, axis1=2, axis2=3) >= 0), "nothing broke: choose a harder case"
    assert np.all(np.isfinite(factored))
    assert np.all(np.diagonal(factored, axis1=2, axis2=3) >= 0)
    lowest = np.linalg.eigvalsh(factored.astype(float))[..., 0] / np.trace(factored, axis1=2, axis2=3)
    assert lowest.min() >= -1e-6


def test_sigma_points_all_around_the_radar():
    """S is indefinite there in the full form; here it is a covariance, and the update finite."""
    full, factored = lists(random_roots(7).astype(np.float32) * 1e5)

    @jax.jit
    def update(tracks):
        predicted = kalman.predict(tracks, 0.1, PARAMS)
        expected = kalman.predict_detections(predicted, PARAMS)
        seen = Detections.from_values(elevation_bearing_range(tracks.mean))
        return expected.covariance, kalman.update(predicted, expected, seen, jnp.arange(COUNT))

    assert np.linalg.eigvalsh(np.asarray(update(full)[0], float)).min() < 0
    S, updated = update(factored)
    assert np.linalg.eigvalsh(np.asarray(S, float)).min() > 0
    assert np.all(np.isfinite(updated.mean))
    assert np.all(np.isfinite(updated.covariance))
    assert np.all(np.diagonal(updated.covariance, axis1=1, axis2=2) >= 0)


def play_tracker(form):
    """Twelve steps of a tracker with tentative tracks, by the linear filter, which is quick to compile."""
    static = StaticParams(covariance_form=form, filter="extended", initiator="multi_measurement")
    params, seen = dataclasses.replace(PARAMS, deletion_threshold=1e5), detections(12)

    def step(tracks, scan):
        value, active, index = scan
        given = Detections.from_values(value, active)
        tracks, _ = tracker.step(tracks, given, 0.5, index, params, static)
        return tracks, tracks

    active = np.random.default_rng(8).random((12, COUNT)) < 0.7
    start = lifecycle.no_tracks(5, static)
    return jax.jit(lambda: jax.lax.scan(step, start, (seen, active, jnp.arange(1, 13)))[1])()


def test_the_tracker_takes_the_same_decisions(x64):
    full, factored = (play_tracker(form) for form in ("full", "square_root"))
    live = np.asarray(full.active)
    assert live.any()
    np.testing.assert_array_equal(factored.active, live)
    np.testing.assert_array_equal(factored.updated_by, full.updated_by)
    check_same(
        *(jax.tree.map(lambda leaf: leaf[live], each.replace(tentative=None)) for each in (full, factored))
    )
    last = factored.covariance[-1][live[-1]]
    np.testing.assert_allclose(square(factored.root[-1])[live[-1]], last, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("held", "asked"), [("full", "square_root"), ("square_root", "full")])
def test_a_track_list_of_the_other_form_is_refused(held, asked):
    tracks = lifecycle.no_tracks(5, StaticParams(covariance_form=held))
    scene = (tracks, Detections.none(2), 0.1, jnp.asarray(1), PARAMS)
    message = rf"^tracks.root: the form of its covariances is {held}; .* covariance_form = '{asked}'$"
    with pytest.raises(ValueError, match=message):
        tracker.step(*scene, StaticParams(covariance_form=asked))
