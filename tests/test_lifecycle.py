"""Deletion and initiation of tracks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Detections, Params, StaticParams, Tracks
from jaxtrack import params as params_module
from jaxtrack.counts import Counts
from jaxtrack.lifecycle import (
    DELETERS,
    delete_tracks,
    delete_uncertain_tracks,
    initial_estimate,
    initiate_tracks,
    no_tracks,
    take_over,
    unassociated,
)
from jaxtrack.models import inverse_elevation_bearing_range

VALUES = np.array([[0.1, 0.2, 2000], [0.3, -0.4, 4000], [-0.5, 0.6, 6000]])
initiate = jax.jit(initiate_tracks)
estimate = jax.jit(initial_estimate)


def with_traces(*traces):
    count = len(traces)
    covariance = jnp.asarray(traces, dtype=float)[:, None, None] * jnp.eye(6) / 6
    return Tracks.empty(count).replace(covariance=covariance, active=jnp.ones(count, dtype=bool))


def test_deletion_is_strict_and_counts_all_six_states(x64):
    # 6144 / 6 = 1024 and its sums are exact in floating point.
    tracks = with_traces(6144.0, np.nextafter(6144.0, 7000.0) + 1e-9, 100.0)
    kept = delete_uncertain_tracks(tracks, Params(deletion_threshold=6144.0))
    np.testing.assert_array_equal(kept.active, [True, False, True])
    velocity_only = tracks.replace(covariance=jnp.diag(jnp.array([0, 7e3, 0, 0, 0, 0]))[None].repeat(3, 0))
    assert not bool(jnp.any(delete_uncertain_tracks(velocity_only, Params()).active))


def test_deletion_wakes_no_empty_slot(params):
    tracks = with_traces(1.0, 1.0).replace(active=jnp.array([False, True]))
    np.testing.assert_array_equal(delete_uncertain_tracks(tracks, params).active, [False, True])


def test_unassociated_detections_are_active_and_used_by_nobody():
    detections = Detections.from_values(np.zeros((5, 3)), [True, True, True, False, True])
    result = unassociated(detections, jnp.array([4, NO_DETECTION, 1]))
    np.testing.assert_array_equal(result, [True, False, True, False, False])


def test_new_tracks_take_the_first_free_slots_in_order(tracks_at, params):
    tracks = tracks_at(np.arange(30.0).reshape(5, 6), 5, age=jnp.full(5, 9), birth_step=jnp.full(5, 2))
    tracks = tracks.replace(active=jnp.array([True, False, True, False, False]))
    waiting = jnp.array([True, False, True])
    born, dropped = initiate(tracks, Detections.from_values(VALUES), waiting, 11, params)
    np.testing.assert_array_equal(born.active, [True, True, True, True, False])
    np.testing.assert_array_equal(born.updated_by, [NO_DETECTION, 0, NO_DETECTION, 2, NO_DETECTION])
    np.testing.assert_array_equal(born.birth_step, [2, 11, 2, 11, 2])
    np.testing.assert_array_equal(born.birth_detection[jnp.array([1, 3])], [0, 2])
    np.testing.assert_array_equal(born.age, [9, 0, 9, 0, 9])
    assert int(dropped) == 0
    for slot, row in ((1, 0), (3, 2)):
        mean, covariance = estimate(jnp.asarray(VALUES[row], float), params)
        np.testing.assert_allclose(born.mean[slot], mean, rtol=1e-6)
        np.testing.assert_allclose(born.covariance[slot], covariance, rtol=1e-5, atol=1e-3)
    for slot in (0, 2):
        np.testing.assert_array_equal(born.mean[slot], tracks.mean[slot])
        np.testing.assert_array_equal(born.covariance[slot], tracks.covariance[slot])


@pytest.mark.parametrize(("free", "expected_drops"), [([], 3), ([1], 2), ([0, 3], 1), ([0, 1, 2], 0)])
def test_a_full_track_list_drops_the_rest_and_touches_nothing_else(free, expected_drops, tracks_at, params):
    tracks = tracks_at(np.arange(24.0).reshape(4, 6), 4, updated_by=jnp.array([2, -1, -1, -1]))
    tracks = tracks.replace(active=tracks.active.at[jnp.array(free, dtype=int)].set(False))
    born, dropped = initiate(tracks, Detections.from_values(VALUES), jnp.ones(3, bool), 5, params)
    assert int(dropped) == expected_drops
    assert bool(jnp.all(born.active))
    for slot in set(range(4)) - set(free):
        before, after = (jax.tree.map(lambda leaf, row=slot: leaf[row], each) for each in (tracks, born))
        jax.tree.map(np.testing.assert_array_equal, after, before)
    for row, slot in enumerate(free):
        np.testing.assert_allclose(born.mean[slot, 4], VALUES[row, 2] * np.sin(VALUES[row, 0]), rtol=1e-5)


def test_more_free_slots_than_detections(params):
    one = Detections.from_values(VALUES[:1])
    born, dropped = initiate(Tracks.empty(3), one, jnp.ones(1, bool), 1, params)
    np.testing.assert_array_equal(born.active, [True, False, False])
    assert int(dropped) == 0


@pytest.mark.parametrize("row", range(3))
def test_the_first_estimate_inverts_the_measurement(row, x64):
    params = Params(elevation_sigma=1e-3, bearing_sigma=4e-3, range_sigma=7.0, prior_velocity_sigma=25.0)
    mean, covariance = estimate(jnp.asarray(VALUES[row]), params)
    np.testing.assert_allclose(mean[0::2], inverse_elevation_bearing_range(jnp.asarray(VALUES[row])))
    np.testing.assert_array_equal(mean[1::2], np.zeros(3))
    # Along the unit vectors of elevation, bearing and range the sigmas are r s_el, r cos(el) s_az, s_r.
    el, az, r = VALUES[row]
    axes = np.array(
        [
            [-np.sin(el) * np.cos(az), -np.sin(el) * np.sin(az), np.cos(el)],
            [-np.sin(az), np.cos(az), 0],
            [np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)],
        ]
    )
    variances = np.array([r * 1e-3, r * np.cos(el) * 4e-3, 7.0]) ** 2
    np.testing.assert_allclose(covariance[0::2, 0::2], (axes.T * variances) @ axes, rtol=1e-9)
    np.testing.assert_allclose(covariance[1::2, 1::2], 625.0 * np.eye(3))
    np.testing.assert_array_equal(covariance[0::2, 1::2], np.zeros((3, 3)))
    np.testing.assert_array_equal(covariance[1::2, 0::2], np.zeros((3, 3)))


def test_a_track_begins_at_rest_in_the_world_whatever_the_platform_does():
    mean, covariance = estimate(jnp.asarray(VALUES), Params(platform_speed=200.0))
    at_rest, same = estimate(jnp.asarray(VALUES), Params())
    np.testing.assert_array_equal(mean[:, 1::2], [[-200, 0, 0]] * 3)
    assert not np.signbit(at_rest[:, 1::2]).any()
    np.testing.assert_array_equal(mean[:, 0::2], at_rest[:, 0::2])
    np.testing.assert_array_equal(covariance, same)


def counted(missed_steps, missed_time):
    """Tracks of these counts, of which every other one is uncertain."""
    count = len(missed_steps)
    tracks = with_traces(*([1.0, 1e9] * count)[:count])
    counts = Counts.zero(count).replace(
        missed_steps=jnp.array(missed_steps), missed_time=jnp.array(missed_time)
    )
    return tracks.replace(counts=counts)


@pytest.mark.parametrize(
    ("deleters", "all_of_them", "kept"),
    [
        (("covariance",), False, [True, False, True, False]),
        (("update_time_steps",), False, [True, True, False, False]),
        (("update_time",), False, [True, True, True, False]),
        (("covariance", "update_time_steps"), False, [True, False, False, False]),
        (("covariance", "update_time_steps"), True, [True, True, True, False]),
    ],
)
def test_deleters_by_hand(deleters, all_of_them, kept):
    """Three steps without a detection are too many; half a second is not, a microsecond more is."""
    tracks = counted([0, 2, 3, 4], [0, 400_000, 500_000, 500_001])
    params = Params(deletion_time=0.5, deletion_steps=3)
    static = StaticParams(deleters=deleters, intersect_deleters=all_of_them)
    np.testing.assert_array_equal(delete_tracks(tracks, static, params).active, kept)


def test_a_deleter_without_its_number_or_its_counts_is_an_error(params):
    tracks = counted([0], [0])
    with pytest.raises(ValueError, match=r"^deletion_time = None: expected"):
        delete_tracks(tracks, StaticParams(deleters=("update_time",)), params)
    static = StaticParams(deleters=("update_time_steps",))
    with pytest.raises(ValueError, match=r"^deletion_steps = None: expected"):
        delete_tracks(tracks, static, params)
    with pytest.raises(ValueError, match=r"^tracks.counts = None: expected .* lifecycle.no_tracks"):
        delete_tracks(Tracks.empty(2), static, params.replace(deletion_steps=3))


def test_every_part_can_be_asked_for_by_name():
    assert tuple(DELETERS) == params_module.DELETERS


def test_a_list_keeps_only_what_its_parts_ask_for():
    assert len(jax.tree.leaves(no_tracks(3, StaticParams()))) == len(jax.tree.leaves(Tracks.empty(3)))
    by_time = no_tracks(3, StaticParams(deleters=("update_time",)))
    assert by_time.counts is not None
    assert by_time.tentative is None
    several = no_tracks(3, StaticParams(initiator="multi_measurement"))
    assert several.tentative.counts.hits.shape == (3,)
    assert several.tentative.tentative is None


def test_confirmed_tracks_take_the_first_free_slots_in_order(tracks_at):
    static = StaticParams(initiator="multi_measurement")
    held = tracks_at(np.arange(24.0).reshape(4, 6), 4, age=jnp.arange(4), counts=Counts.zero(4))
    tracks = no_tracks(4, static).replace(active=jnp.array([True, False, True, False]))
    for confirmed, taken, drops in (([0, 1, 0, 1], [1, 3], 0), ([1, 1, 1, 0], [0, 1], 1)):
        confirmed = jnp.array(confirmed, dtype=bool)
        after, dropped = jax.jit(take_over)(tracks, held, confirmed)
        np.testing.assert_array_equal(after.active, [True] * 4)
        np.testing.assert_array_equal(after.mean[jnp.array([1, 3])], held.mean[jnp.array(taken)])
        np.testing.assert_array_equal(after.age[jnp.array([1, 3])], taken)
        np.testing.assert_array_equal(after.mean[jnp.array([0, 2])], tracks.mean[jnp.array([0, 2])])
        assert int(dropped) == drops
