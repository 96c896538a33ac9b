"""Recorded episodes as Stone Soup's objects and back, and Stone Soup's own tools on them."""

import datetime

import jax
import matplotlib as mpl
import numpy as np
import pytest
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.reader.yaml import YAMLDetectionReader, YAMLGroundTruthReader, YAMLTrackReader
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.prediction import Prediction
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track
from stonesoup.types.update import Update
from stonesoup.writer.yaml import YAMLWriter

from jaxtrack import NO_DETECTION, make, metrics
from jaxtrack.policies import POLICIES
from jaxtrack.recording import record_episode
from jaxtrack.siap import siap
from reference.components import build_components, gospa_metric, step_duration, time_of
from reference.parity.compare import TOLERANCE
from reference.parity.stock_metrics import (
    GOSPA_PARTS,
    SIAP_RATIOS,
    depends_on_set_order,
    siap_generator,
    track_to_truth,
)
from reference.stone_soup_objects import take_slots, to_stone_soup, to_track_record, to_trajectories
from reference.translate import as_vector, to_stone_soup_tracks, track_key

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 250
NUMBERS = {
    "num_truths": 6,
    "max_tracks": 8,
    "map_size": 12,
    "field_limit": 0.3,
    "num_looks": 5,
    "time_step": 0.05,
    "initial_truths": 3,
    "birth_rate": 0.03,
    "death_probability": 0.01,
    "clutter_rate": 0.02,
    "detection_probability": 0.9,
    "deletion_threshold": 3200.0,
    "gospa_switching_penalty": 30.0,
}


@pytest.fixture(scope="module")
def episode():
    """Truths and tracks begin and end, and slots are used again."""
    env, params = make(**NUMBERS)
    return record_episode(env, params, POLICIES["scheduler"](env.static, params), jax.random.key(3), STEPS)


@pytest.fixture(scope="module")
def found(episode):
    return to_stone_soup(episode)


def in_order(paths):
    return sorted(paths, key=lambda path: int(path.id))


def assert_same_tracks(ours, theirs):
    """Bit for bit, in rows that hold a track."""
    np.testing.assert_array_equal(theirs.active, ours.active)

    def in_use(mine, other):
        np.testing.assert_array_equal(np.asarray(other)[ours.active], mine[ours.active])

    jax.tree.map(in_use, ours, theirs)


def test_everything_happens_in_the_episode(episode, found):
    tracks, truths = episode.states.tracks, episode.states.truths
    used_again = [len({*zip(*births, strict=True)}) for births in used_births(tracks)]
    assert max(used_again) > 1
    assert len(found.tracks) > max(np.sum(tracks.active, axis=1))
    assert np.any(truths.alive[:-1] & ~truths.alive[1:])
    assert np.any(~truths.alive[:-1] & truths.alive[1:])
    assert np.any(episode.records.detections.active.sum(axis=1) > 1)


def used_births(tracks):
    for slot in range(tracks.active.shape[1]):
        rows = tracks.active[:, slot]
        yield tracks.birth_step[rows, slot], tracks.birth_detection[rows, slot]


def test_tracks_and_truths_come_back_bit_for_bit(episode, found):
    tracks, truths = episode.states.tracks, episode.states.truths
    assert_same_tracks(tracks, to_track_record(found.tracks, tracks.active.shape[1], found.times))
    paths = in_order(found.groundtruth_paths)
    rows = [int(path.id) for path in paths]
    assert rows == np.flatnonzero(truths.alive.any(axis=0)).tolist()
    expected = np.where(truths.alive[..., None], truths.state, np.nan)[:, rows]
    np.testing.assert_array_equal(to_trajectories(paths, found.times), expected)


def test_truths_replayed_are_the_same_truths(episode, found):
    """The first row of trajectories is the reset, so step k of the replay is row k + 1 of the record."""
    trajectories = to_trajectories(in_order(found.groundtruth_paths), found.times)
    env, params = make(
        **{**NUMBERS, "num_truths": trajectories.shape[1], "initial_truths": None}, trajectories=trajectories
    )
    replay = record_episode(env, params, POLICIES["static"](env.static, params), jax.random.key(0), 40)
    rows = [int(path.id) for path in in_order(found.groundtruth_paths)]
    alive = episode.states.truths.alive[1:41, rows]
    np.testing.assert_array_equal(replay.states.truths.alive, alive)
    expected = episode.states.truths.state[1:41, rows]
    np.testing.assert_array_equal(replay.states.truths.state[alive], expected[alive])


def test_states_are_updates_where_a_detection_updated_the_track(episode, found):
    tracks, detections = episode.states.tracks, episode.records.detections
    predicted = episode.records.tracker.predicted
    steps = {time: step for step, time in enumerate(found.times)}
    scans = dict(found.scans)
    kinds = {Update: 0, Prediction: 0}
    for track in found.tracks:
        for state in track:
            step = steps[state.timestamp]
            keys = zip(tracks.birth_step[step], tracks.birth_detection[step], strict=True)
            (slot,) = (
                slot for slot, key in enumerate(keys) if key == track_key(track) and tracks.active[step, slot]
            )
            row = tracks.updated_by[step, slot]
            kind = Prediction if row == NO_DETECTION else Update
            assert isinstance(state, kind)
            kinds[kind] += 1
            if kind is Update:
                detection = state.hypothesis.measurement
                assert detection in scans[state.timestamp]
                value = as_vector(detection.state_vector)
                # Stone Soup's angles wrap what is in range already, to the last bit.
                np.testing.assert_allclose(value, detections.value[step, row], rtol=1e-15, atol=1e-15)
            if kind is Update and step + 1 > track_key(track)[0]:
                prior = state.hypothesis.prediction
                np.testing.assert_array_equal(as_vector(prior.state_vector), predicted.mean[step, slot])
                np.testing.assert_array_equal(prior.covar, predicted.covariance[step, slot])
    assert min(kinds.values()) > 20
    assert len(found.detections) == detections.active.sum()


def test_gospa_and_siap_of_stone_soup_equal_ours(episode, found):
    truths, tracks, params = episode.states.truths, episode.states.tracks, episode.params
    generators = [gospa_metric(params), siap_generator()]
    manager = MultiManager(generators, track_to_truth(params))
    manager.add_data({"tracks": found.tracks, "groundtruth_paths": found.groundtruth_paths})
    manager.generate_metrics()
    theirs = manager.metrics[generators[0].generator_name]["GOSPA Metrics"].value
    ours = jax.jit(metrics.gospa_over_time)(truths, tracks, params)
    steps = {time: step for step, time in enumerate(found.times)}
    assert len(theirs) > STEPS / 2
    for single in theirs:
        for part in GOSPA_PARTS:
            expected = getattr(ours, part)[steps[single.timestamp]]
            assert single.value[part] == pytest.approx(float(expected), rel=TOLERANCE, abs=TOLERANCE)
    seconds = np.arange(STEPS) * step_duration(params).total_seconds()
    ours = jax.jit(siap)(truths, tracks, seconds, params)
    ratios = manager.metrics[generators[1].generator_name]
    for name, title in SIAP_RATIOS.items():
        assert ratios[title].value == pytest.approx(float(getattr(ours, name)), rel=TOLERANCE), name
    assert 0.1 < ours.completeness < 1
    assert not depends_on_set_order(manager.association_set, found.groundtruth_paths)
    rate = ratios["SIAP Rate of Track Number Change"].value
    assert rate == pytest.approx(float(ours.track_change_rate), rel=TOLERANCE)


def test_stone_soups_tracker_makes_the_same_tracks_of_the_detections(episode, found):
    parts = build_components(episode.params, exact_jacobian=True)
    tracker, tracks = parts.tracker(), set()
    deletions = 0
    for time, scan in found.scans:
        exact = set()
        for one in scan:
            fields = {"timestamp": time, "measurement_model": parts.measurement_model}
            exact.add(Detection(one.state_vector, metadata=one.metadata, **fields))
        before = set(tracker.tracks)
        tracker.update_tracker(time, exact)
        for dead in before - tracker.tracks:
            del dead.states[-1]  # the prediction for which it was deleted
            deletions += 1
        tracks |= tracker.tracks
    assert deletions
    ours = episode.states.tracks
    theirs = to_track_record(tracks, ours.active.shape[1], found.times)
    for name in ("active", "updated_by", "birth_step", "birth_detection"):
        mask = slice(None) if name == "active" else ours.active
        np.testing.assert_array_equal(np.asarray(getattr(theirs, name))[mask], getattr(ours, name)[mask])
    np.testing.assert_allclose(theirs.mean[ours.active], ours.mean[ours.active], rtol=1e-8, atol=1e-6)


def test_stone_soups_plotter_draws_them(found):
    mpl.use("Agg")
    from matplotlib import pyplot
    from stonesoup.plotter import Plotter

    plotter = Plotter()
    plotter.plot_ground_truths(found.groundtruth_paths, [0, 2])
    plotter.plot_measurements(found.detections, [0, 2])
    plotter.plot_tracks(found.tracks, [0, 2], uncertainty=True)
    drawn = {tuple(map(float, np.ravel(line.get_xdata()))) for line in plotter.ax.lines}
    for one in found.tracks | found.groundtruth_paths:
        assert tuple(float(state.state_vector[0]) for state in one) in drawn
    (points,) = (dots for dots in plotter.ax.collections if len(dots.get_offsets()) == len(found.detections))
    assert np.all(np.isfinite(points.get_offsets()))
    pyplot.close(plotter.fig)


def test_stone_soups_writer_writes_them_and_its_readers_read_them_back(episode, tmp_path):
    env, params = make(**NUMBERS)
    policy = POLICIES["scheduler"](env.static, params)
    short = to_stone_soup(record_episode(env, params, policy, jax.random.key(3), 25))
    path = tmp_path / "episode.yaml"
    with YAMLWriter(path, tracks_source=short, groundtruth_source=short, detections_source=short) as writer:
        writer.write()
    ((when, tracks),) = YAMLTrackReader(path)
    assert when == short.times[-1]
    ours = jax.tree.map(lambda leaf: leaf[:25], episode.states.tracks)
    assert ours.active.any()
    assert_same_tracks(ours, to_track_record(tracks, env.static.max_tracks, short.times))
    ((_, paths),) = YAMLGroundTruthReader(path)
    np.testing.assert_array_equal(
        to_trajectories(in_order(paths), short.times),
        to_trajectories(in_order(short.groundtruth_paths), short.times),
    )
    ((_, detections),) = YAMLDetectionReader(path)
    assert {one.metadata["step"] for one in detections} == {one.metadata["step"] for one in short.detections}
    assert len(detections) == len(short.detections) > 0


def gaussian(step, x, params):
    return GaussianState([x, 0, 0, 0, 0, 0], np.eye(6) * (step + 1), timestamp=time_of(step, params))


def test_tracks_from_elsewhere_are_numbered_by_their_births(params):
    """Tracks without metadata: two born together, one of which frees its slot for a third."""
    first = Track([gaussian(step, 1.0, params) for step in (0, 1)])
    second = Track([gaussian(step, 2.0, params) for step in (0, 1, 2, 3)])
    third = Track([gaussian(step, 0.5, params) for step in (2, 3)])
    record = to_track_record({first, second, third}, 3)
    np.testing.assert_array_equal(record.mean[:, :2, 0], [[1, 2], [1, 2], [0.5, 2], [0.5, 2]])
    np.testing.assert_array_equal(record.covariance[:, 1, 3, 3], [1, 2, 3, 4])
    np.testing.assert_array_equal(record.active, [[True, True, False]] * 4)
    np.testing.assert_array_equal(record.birth_step[:, :2], [[1, 1], [1, 1], [3, 1], [3, 1]])
    np.testing.assert_array_equal(record.birth_detection[:, :2], [[0, 1], [0, 1], [0, 1], [0, 1]])
    np.testing.assert_array_equal(record.age[:, :2], [[0, 0], [1, 1], [0, 2], [1, 3]])
    assert np.all(record.updated_by == NO_DETECTION)
    later = to_track_record([second, third], 2, [time_of(step, params) for step in (1, 3)], first_step=5)
    np.testing.assert_array_equal(later.mean[:, :, 0], [[2, 0], [2, 0.5]])
    np.testing.assert_array_equal(later.birth_step[1], [5, 6])


def test_more_tracks_than_slots_are_refused(params):
    tracks = [Track([gaussian(0, float(x), params)]) for x in range(3)]
    with pytest.raises(ValueError, match=r"^3 tracks at .*: expected at most max_tracks = 2$"):
        to_track_record(tracks, 2)


def test_paths_of_another_space_are_refused():
    path = GroundTruthPath([GroundTruthState([1, 2, 3, 4], timestamp=datetime.datetime(2000, 1, 1))])
    with pytest.raises(ValueError, match=r"^paths\[0\]: states with 4 entries; expected 6$"):
        to_trajectories([path])


def test_paths_without_given_times_have_all_of_theirs(params):
    early = GroundTruthPath(
        [GroundTruthState([step] * 6, timestamp=time_of(step, params)) for step in (0, 1)]
    )
    late = GroundTruthPath([GroundTruthState([9] * 6, timestamp=time_of(2, params))])
    trajectories = to_trajectories([late, early])
    np.testing.assert_array_equal(trajectories[:, :, 0], [[np.nan, 0], [np.nan, 1], [9, np.nan]])


def test_a_track_keeps_its_slot_and_waits_where_none_is_free(params):
    a, b, c, d = (Track([gaussian(0, float(x), params)]) for x in range(4))
    slots = [None, None, None]
    for live, held in (
        ({b, a, d, c}, [a, b, c]),
        ({a, c, d}, [a, d, c]),
        ({c}, [None, None, c]),
        ({c, b}, [b, None, c]),
    ):
        slots = take_slots(slots, live)
        assert slots == held


def test_tracks_born_together_take_slots_in_the_order_of_their_detections(params, tracks_at):
    """Also where their states, by which others are told apart, have another order."""
    means = np.arange(6.0)[:, None] * np.ones(6)
    births = {"birth_step": np.zeros(6, int), "birth_detection": np.array([3, 0, 5, 1, 4, 2])}
    tracks = to_stone_soup_tracks(tracks_at(means, 6, **births), time_of(0, params))
    slots = take_slots([None] * 6, tracks)
    assert [track_key(track) for track in slots] == [(0, row) for row in range(6)]
    record = to_track_record(tracks, 6, first_step=0)
    np.testing.assert_array_equal(record.birth_detection, [range(6)])
    np.testing.assert_array_equal(record.mean[0, :, 0], [1, 3, 5, 0, 4, 2])
