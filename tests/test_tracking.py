"""The tracker on recorded detections: nothing is dropped, whatever the capacities."""

import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Params, StaticParams, tracking
from jaxtrack.detection_file import RecordedDetections
from jaxtrack.tracking import track_scans

PARAMS = Params(deletion_threshold=4000.0)

pytestmark = pytest.mark.usefixtures("quick_compilation", "x64")


def recording(counts, seed=0):
    """Targets that stand still, the first `counts[k]` of them seen in scan k, at uneven times."""
    rng = np.random.default_rng(seed)
    places = np.stack([rng.uniform(-1, 1, 40), rng.uniform(-3, 3, 40), rng.uniform(1000, 9000, 40)], axis=1)
    times = np.cumsum(rng.choice([0.1, 0.25, 0.7], len(counts)))
    noise = [2e-3, 2e-3, 5.0]
    scans = [places[:count] + noise * rng.standard_normal((count, 3)) for count in counts]
    return RecordedDetections.from_scans(times, scans)


def table(chunks):
    """All rows of all chunks."""
    chunks = list(chunks)
    names = ("scan", "track", "mean", "covariance", "detection")
    return {name: np.concatenate([getattr(rows, name) for rows in chunks]) for name in names}


def assert_same(ours, theirs):
    """The same decisions; numbers but for the last bits, which depend on how a program is vectorised."""
    for name in ("scan", "track", "detection"):
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    for name in ("mean", "covariance"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-10, atol=1e-9, err_msg=name)


COUNTS = [2, 3, 0, 5, 5, 12, 12, 6, 0, 0, 0, 0, 0, 0, 4, 4, 4, 7, 2]


@pytest.fixture(scope="module")
def recorded():
    return recording(COUNTS)


@pytest.fixture
def large(recorded, monkeypatch):
    """Tracked in one call, with room for everything from the start."""
    monkeypatch.setattr(tracking, "SMALLEST", 32)
    return table(track_scans(recorded, PARAMS, chunk=len(COUNTS)))


def test_slots_grow_and_shrink_without_a_trace(recorded, large, monkeypatch):
    """Three scans a call: from 8 slots to 16 and back, in which tracks move to other slots."""
    monkeypatch.setattr(tracking, "SMALLEST", 8)
    sizes, resized = [], tracking._resized

    def watched(state, slots, static):
        state = resized(state, slots, static)
        sizes.append(state.number.shape[0])
        return state

    monkeypatch.setattr(tracking, "_resized", watched)
    chunks = list(track_scans(recorded, PARAMS, chunk=3))
    assert sizes[0] == sizes[-1] == 8
    assert max(sizes) == 16
    assert [rows.scans for rows in chunks] == [range(k, min(k + 3, 19)) for k in range(0, 19, 3)]
    assert_same(table(chunks), large)


def test_a_call_that_ran_out_of_slots_is_repeated_with_more(monkeypatch):
    """More live tracks than detections in any scan: every target is seen in its own scan."""
    monkeypatch.setattr(tracking, "SMALLEST", 8)
    places = np.array([[0.1, 0.25 * k, 2000.0 + 300 * k] for k in range(12)])
    recorded = RecordedDetections.from_scans(0.01 * np.arange(12), list(places[:, None]))
    rows = table(track_scans(recorded, PARAMS, chunk=3))
    np.testing.assert_array_equal(rows["track"], np.concatenate([np.arange(k + 1) for k in range(12)]))
    monkeypatch.setattr(tracking, "SMALLEST", 32)
    assert_same(rows, table(track_scans(recorded, PARAMS, chunk=len(COUNTS))))


def test_tracks_are_numbered_by_birth_and_know_their_detection(large):
    first = {}
    for scan, track, detection in zip(large["scan"], large["track"], large["detection"], strict=True):
        first.setdefault(track, (scan, detection))
    assert list(first) == sorted(first) == list(range(len(first)))
    births = list(first.values())
    assert births == sorted(births)
    assert births[:3] == [(0, 0), (0, 1), (1, 2)]
    np.testing.assert_array_equal(np.lexsort((large["track"], large["scan"])), np.arange(len(large["scan"])))
    in_empty_scans = large["detection"][np.isin(large["scan"], np.flatnonzero(np.array(COUNTS) == 0))]
    assert len(in_empty_scans) > 20
    assert np.all(in_empty_scans == NO_DETECTION)


def test_rows_stay_in_order_of_birth_when_a_new_track_takes_an_old_slot():
    gone, stays, comes = ([0.1, bearing, 3000.0] for bearing in (0.0, 1.0, 2.0))
    scans = [[gone, stays], [stays], [stays], [comes, stays], [comes, stays], [comes, stays], [stays]]
    recorded = RecordedDetections.from_scans(0.5 * np.arange(7), [np.array(scan) for scan in scans])
    rows = table(track_scans(recorded, PARAMS, chunk=3))
    assert rows["scan"].tolist() == [0, 0, 1, 1, 2, 3, 3, 4, 4, 5, 5, 6, 6]
    assert rows["track"].tolist() == [0, 1, 0, 1, 1, 1, 2, 1, 2, 1, 2, 1, 2]
    assert rows["detection"].tolist() == [0, 1, -1, 0, 0, 1, 0, 1, 0, 1, 0, 0, -1]


def test_exact_ties_do_not_depend_on_capacity(monkeypatch):
    """Detections written twice make twins; the next detection is as near to both, the older gets it."""
    rng = np.random.default_rng(1)
    place = np.array([0.1, 0.2, 3000.0])
    scans = [np.repeat([place], 2, axis=0)]
    scans += [place + [[2e-3, 2e-3, 5.0]] * rng.standard_normal((1, 3)) for _ in range(8)]
    recorded = RecordedDetections.from_scans(0.1 * np.arange(9), scans)
    tables = []
    for smallest, chunk in ((8, 3), (32, len(COUNTS))):
        monkeypatch.setattr(tracking, "SMALLEST", smallest)
        tables.append(table(track_scans(recorded, PARAMS, chunk=chunk)))
    assert_same(*tables)
    np.testing.assert_array_equal(tables[0]["detection"][:4], [0, 1, 0, NO_DETECTION])


def test_long_calls_are_cut_where_tracks_are_many(monkeypatch):
    monkeypatch.setattr(tracking, "CHUNK_BYTES", 3 * 8 * 42 * 8 + 1)
    chunks = list(track_scans(recording([2, 3, 0, 5, 3, 1, 2]), PARAMS))
    assert [len(rows.scans) for rows in chunks] == [3, 3, 1]


def test_time_steps_are_whole_microseconds(monkeypatch):
    """A third of a second is 0.333333 s, also from 1.6e9 s on."""
    monkeypatch.setattr(tracking, "SMALLEST", 8)
    recorded = RecordedDetections.from_scans([1.6e9, 1.6e9 + 1 / 3], [[[0.1, 0.2, 3000.0]], []])
    variance = table(track_scans(recorded, Params(), chunk=3))["covariance"][:, 1, 1]
    growth = np.diff(variance)
    np.testing.assert_allclose(growth, Params().process_noise * 0.333333, rtol=1e-10)


def test_no_scans_no_rows():
    assert list(track_scans(RecordedDetections.from_scans([], []), PARAMS)) == []


def test_too_many_pairs_for_memory_are_refused(recorded, monkeypatch):
    monkeypatch.setattr(tracking, "MEMORY_LIMIT", 10_000)
    with pytest.raises(ValueError, match=r"time .*: 12 detections in one scan and \d+ tracks need .* GB"):
        list(track_scans(recorded, PARAMS, chunk=3))


def test_an_estimate_that_is_not_finite_is_named():
    recorded = RecordedDetections.from_scans([0.5], [[[0.1, 0.2, 3000.0], [0.1, 0.2, 1e200]]])
    with pytest.raises(ValueError, match=r"time 0\.5, track 1: its estimate is not finite"):
        list(track_scans(recorded, PARAMS, chunk=3))


def test_slots_of_tentative_tracks_grow_and_shrink_without_a_trace(recorded, monkeypatch):
    static = StaticParams(initiator="multi_measurement", deleters=("update_time_steps",))
    params, tables, sizes, resized = PARAMS.replace(deletion_steps=3), [], set(), tracking._resized

    def watched(state, slots, static):
        state = resized(state, slots, static)
        sizes.add(state.number.shape[0])
        return state

    for smallest, chunk in ((8, 3), (32, len(COUNTS))):
        monkeypatch.setattr(tracking, "SMALLEST", smallest)
        monkeypatch.setattr(tracking, "_resized", watched)
        tables.append(table(track_scans(recorded, params, chunk, static)))
    assert sizes >= {8, 16, 32}
    assert_same(*tables)
    assert len(tables[0]["scan"]) > 30


def test_tentative_tracks_need_room_too(monkeypatch):
    """Twelve tentative tracks and no other, kept from call to call; then all are seen again."""
    monkeypatch.setattr(tracking, "SMALLEST", 8)
    places = np.array([[0.1, 0.25 * k, 2000.0 + 300 * k] for k in range(12)])
    recorded = RecordedDetections.from_scans(0.01 * np.arange(13), [*places[:, None], places])
    rows = table(track_scans(recorded, PARAMS, 3, StaticParams(initiator="multi_measurement")))
    assert rows["scan"].tolist() == [12] * 12
    assert rows["track"].tolist() == rows["detection"].tolist() == list(range(12))
    np.testing.assert_allclose(rows["mean"][:, 4], places[:, 2] * np.sin(0.1), atol=1.0)
