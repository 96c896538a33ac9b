"""What must hold for the tracker and the environment in any scene, drawn by Hypothesis.

    pytest tests/test_properties.py --hypothesis-profile=thorough

draws forty times as many scenes. Properties of one function alone stand beside its other tests.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtrack import Detections, Params, Tracks, kalman, tracker
from jaxtrack.models import inverse_elevation_bearing_range

pytestmark = pytest.mark.usefixtures("quick_compilation")

SLOTS, DETECTIONS, STEPS = 6, 4, 12
DT = 0.1
# Some tracks are so uncertain that they end in the step, most are not.
PARAMS = Params(deletion_threshold=1e7)
step = jax.jit(lambda tracks, detections: tracker.step(tracks, detections, DT, 7, PARAMS))
predict = jax.jit(kalman.predict)
few = settings(max_examples=max(3, settings.default.max_examples // 8))

seeds = st.integers(0, 2**32 - 1)
masks = st.lists(st.booleans(), min_size=SLOTS, max_size=SLOTS)
seen = st.lists(st.booleans(), min_size=DETECTIONS, max_size=DETECTIONS)
spreads = st.sampled_from([1e-3, 1e-2, 0.1])


@st.composite
def scenes(draw, spread=spreads):
    """Tracks all around the radar, and detections near some of them and elsewhere."""
    rng = np.random.default_rng(draw(seeds))
    active, detected, spread = np.array(draw(masks)), np.array(draw(seen)), draw(spread)
    distance = 10 ** rng.uniform(3, 5, SLOTS)
    places = np.stack([rng.uniform(-1.2, 1.2, SLOTS), rng.uniform(-np.pi, np.pi, SLOTS), distance], axis=-1)
    mean = np.zeros((SLOTS, 6))
    mean[:, ::2] = inverse_elevation_bearing_range(jnp.asarray(places))
    mean[:, 1::2] = rng.normal(0, 100, (SLOTS, 3))
    sigma = np.stack([spread * distance, rng.uniform(1, 30, SLOTS)] * 3, axis=-1)
    root = sigma[..., None] * np.tril(rng.normal(0, 0.2, (SLOTS, 6, 6)) + np.eye(6))
    tracks = Tracks.empty(SLOTS).replace(
        mean=jnp.asarray(mean),
        covariance=jnp.asarray(root @ np.swapaxes(root, 1, 2)),
        active=jnp.asarray(active),
        birth_step=jnp.arange(SLOTS),
        birth_detection=jnp.zeros(SLOTS, dtype=int),
    )
    near = places[rng.permutation(SLOTS)[:DETECTIONS]]
    noise = rng.normal(0, 1, (DETECTIONS, 3)) * np.stack([[spread, spread, 1]] * DETECTIONS)
    noise[:, 2] *= spread * near[:, 2]
    return tracks, Detections.from_values(near + rng.choice([0.3, 3.0]) * noise, detected)


def rows(record, order):
    return jax.tree.map(lambda leaf: leaf[np.asarray(order)], record)


def numbers(record):
    """Means and covariances of the live tracks, in an order that no slot decides, beside the dead."""
    live = np.asarray(record.active)
    table = np.concatenate([record.mean, np.reshape(record.covariance, (len(live), -1))], axis=1)[live]
    return table[np.lexsort(np.round(table[:, :6:2], 3).T)]


def same_tracks(these, those, rtol=1e-8):
    """Whether two track lists hold the same tracks, in whatever slots."""
    a, b = numbers(these), numbers(those)
    assert a.shape == b.shape
    scale = np.abs(b).max(initial=1.0)
    np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * scale)


def flipped(tracks, detections, signs):
    """The scene mirrored where a sign is -1: x and y by the bearing, z by the elevation."""
    x, y, z = signs
    each = jnp.repeat(jnp.array([x, y, z], dtype=float), 2)
    elevation, bearing, distance = jnp.moveaxis(detections.value, -1, 0)
    bearing = y * bearing if x > 0 else jnp.pi - y * bearing
    return (
        tracks.replace(mean=tracks.mean * each, covariance=tracks.covariance * each[:, None] * each),
        detections.replace(value=jnp.stack([z * elevation, bearing, distance], axis=-1)),
    )


def turned(tracks, detections, angle):
    """The scene turned about the vertical axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.kron(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]), np.eye(2))
    return (
        tracks.replace(mean=tracks.mean @ turn.T, covariance=turn @ tracks.covariance @ turn.T),
        detections.replace(value=detections.value.at[:, 1].add(angle)),
    )


@given(scenes(), seeds)
def test_covariances_stay_symmetric_and_positive_through_a_whole_step(x64, scene, seed):
    tracks, detections = scene
    rng = np.random.default_rng(seed)
    for _ in range(STEPS):
        tracks, info = step(tracks, detections)
        for each in (info.predicted, info.updated, tracks):
            P = np.asarray(each.covariance)[np.asarray(each.active)]
            assert np.all(np.isfinite(P))
            traces = np.trace(P, axis1=1, axis2=2)
            np.testing.assert_array_less(np.abs(P - np.swapaxes(P, 1, 2)).max(axis=(1, 2)), 1e-9 * traces)
            np.testing.assert_array_less(-1e-12 * traces, np.linalg.eigvalsh(P)[:, 0])
        detections = detections.replace(active=jnp.asarray(rng.random(DETECTIONS) < 0.5))


@given(scenes(), st.floats(1e-3, 10.0), st.floats(0.0, 100.0))
def test_prediction_never_shrinks_uncertainty(x64, scene, time_step, more):
    # Not every variance: where position and velocity disagree, position gets better for a while. What never
    # shrinks is the volume, the velocity's covariance, and all of it when more process noise is assumed.
    tracks, _ = scene
    after = predict(tracks, time_step, PARAMS)
    volumes = [np.linalg.slogdet(np.asarray(each.covariance))[1] for each in (tracks, after)]
    assert np.all(volumes[1] >= volumes[0] - 1e-6)
    noisier = predict(tracks, time_step, PARAMS.replace(process_noise=PARAMS.process_noise + more))
    grown = after.covariance[:, 1::2, 1::2] - tracks.covariance[:, 1::2, 1::2]
    for change, whole in ((grown, after), (noisier.covariance - after.covariance, noisier)):
        smallest = np.linalg.eigvalsh(np.asarray(change))[:, 0]
        traces = np.trace(np.asarray(whole.covariance), axis1=1, axis2=2)
        np.testing.assert_array_less(-1e-12 * traces, smallest)


@given(scenes(), st.permutations(range(SLOTS)), st.permutations(range(DETECTIONS)))
def test_permuting_slots_and_detections_permutes_the_result(x64, scene, slots, order):
    tracks, detections = scene
    after, info = step(tracks, detections)
    moved, moved_info = step(rows(tracks, slots), rows(detections, order))
    associated = np.asarray(info.associated)
    new_place = np.append(np.argsort(order), -1)
    np.testing.assert_array_equal(moved_info.associated, new_place[associated[np.asarray(slots)]])
    if not (info.num_dropped or moved_info.num_dropped):  # which new track is dropped goes by order
        same_tracks(moved, after)


@given(scenes(), st.integers(0, 2**8 - 1))
def test_what_empty_rows_hold_changes_no_bit(x64, scene, seed):
    tracks, detections = scene
    rng = np.random.default_rng(seed)

    def fill(record):
        def junk(leaf):
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                return leaf
            values = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e300], leaf.shape)
            live = np.reshape(record.active, (-1, *[1] * (leaf.ndim - 1)))
            return jnp.where(live, leaf, values)

        return jax.tree.map(junk, record)

    clean, filled = step(tracks, detections)[0], step(fill(tracks), fill(detections))[0]
    for name in ("active", "updated_by", "age"):
        np.testing.assert_array_equal(getattr(filled, name), getattr(clean, name))
    np.testing.assert_array_equal(numbers(filled), numbers(clean))


@given(scenes())
def test_more_empty_slots_change_nothing(x64, scene):
    tracks, detections = scene
    more = jax.tree.map(lambda *pair: jnp.concatenate(pair), tracks, Tracks.empty(3))
    after, info = step(tracks, detections)
    after_more, _ = step(more, detections)
    if not info.num_dropped:
        same_tracks(after_more, after)


@given(scenes(), st.lists(st.integers(-3, 3), min_size=DETECTIONS, max_size=DETECTIONS))
def test_whole_turns_of_a_bearing_change_nothing(x64, scene, turns):
    tracks, detections = scene
    wound = detections.replace(value=detections.value.at[:, 1].add(2 * jnp.pi * jnp.array(turns)))
    after, info = step(tracks, detections)
    after_wound, info_wound = step(tracks, wound)
    np.testing.assert_array_equal(info_wound.associated, info.associated)
    same_tracks(after_wound, after)
    bearings = np.asarray(info.expected.mean)[:, 1]
    assert np.all((bearings >= -np.pi) & (bearings <= np.pi))


@given(scenes(), st.tuples(*[st.sampled_from([1, -1])] * 3))
def test_mirrors_and_the_half_turn_change_nothing(x64, scene, signs):
    # The half turn is the mirrors of x and y: it carries what lies ahead across the cut of the bearing.
    after, info = step(*scene)
    mirrored, mirrored_info = step(*flipped(*scene, signs))
    np.testing.assert_array_equal(mirrored_info.associated, info.associated)
    same_tracks(flipped(mirrored, scene[1], signs)[0], after)


@given(scenes(spread=st.just(1e-3)), st.floats(-np.pi, np.pi))
def test_turning_about_the_vertical_changes_only_what_the_sigma_points_see(x64, scene, angle):
    # Cholesky's columns do not turn with the covariance, so other points are drawn from the same Gaussian:
    # that is Stone Soup's filter too. The difference is of second order in spread over range.
    after, info = step(*scene)
    other, other_info = step(*turned(*scene, angle))
    back, _ = turned(other, scene[1], -angle)
    for name in ("associated", "deleted", "initiated"):
        np.testing.assert_array_equal(getattr(other_info, name), getattr(info, name))
    updated, live = np.asarray(info.associated) >= 0, np.asarray(after.active)
    np.testing.assert_allclose(back.mean[live & ~updated], after.mean[live & ~updated], rtol=1e-9, atol=1e-6)
    sigmas = np.sqrt(np.diagonal(np.asarray(after.covariance), axis1=1, axis2=2))[live]
    assert np.all(np.abs(back.mean - after.mean)[live] < 1e-4 * sigmas)


@few
@given(st.lists(scenes(), min_size=3, max_size=3))
def test_a_batch_equals_a_loop(x64, batch):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *batch)
    together, _ = step_all(*stacked)
    for row, scene in enumerate(batch):
        same_tracks(jax.tree.map(lambda leaf, row=row: leaf[row], together), step(*scene)[0])


step_all = jax.jit(jax.vmap(lambda tracks, detections: tracker.step(tracks, detections, DT, 7, PARAMS)))


@few
@given(scenes())
def test_compiled_equals_eager(x64, scene):
    same_tracks(step(*scene)[0], tracker.step(*scene, DT, 7, PARAMS)[0])
