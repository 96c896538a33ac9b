"""The benchmark of the tracker: the same inputs and the same results on all sides."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import operations, peers, scene, tracker
from benchmarks.tracker import TrackerOptions
from jaxtrack import NO_DETECTION, Params

pytestmark = pytest.mark.usefixtures("quick_compilation")

OPTIONS = TrackerOptions(tracks=(3, 4), detections=2, batch=2, repeats=2, min_seconds=0.001, seed=5)


@pytest.fixture(scope="module")
def rows():
    return tracker.measure(OPTIONS, Params(), Progress(disable=True))


def test_one_row_for_each_operation_and_number_of_tracks(rows):
    cases = [(row["operation"], row["tracks"]) for row in rows]
    assert cases == [(name, count) for name in ("predict", "update", "step") for count in (3, 4)]


def test_times_ratios_and_equal_results(rows):
    for row in rows:
        others = {"stone_soup"} | ({"filterpy"} if row["operation"] != "step" else set())
        others &= set(row["largest_difference_sigma"])  # FilterPy may not be installed
        assert "stone_soup" in others
        assert set(row["microseconds"]) == {"alone", "batch", *others}
        for micros in row["microseconds"].values():
            assert len(micros["repeats"]) == OPTIONS.repeats
            assert 0 < micros["min"] <= micros["median"] <= micros["max"] < np.inf
        for name, ratio in row["ratios"].items():
            pair = [row["microseconds"][side]["median"] for side in name.split(" / ")]
            assert ratio == pytest.approx(pair[0] / pair[1])
        assert max(row["largest_difference_sigma"].values()) < tracker.TOLERANCE["float64"]
        assert row["compile_seconds"] > 0


def test_a_whole_step_updates_deletes_and_initiates():
    scenes = scene.random_scenes(1, 4, 2, 5, Params())
    only = jax.tree.map(lambda leaf: leaf[0], scenes)
    _, found = peers.StoneSoup(Params()).step(only)
    keys, sources = zip(*found.labels, strict=True)
    assert (0, 0) not in keys
    assert keys[-1] == (scene.STEP, 1)
    assert sorted(sources) == [NO_DETECTION, NO_DETECTION, 0, 1]


@pytest.mark.skipif(not peers.has_filterpy(), reason="needs FilterPy")
def test_filterpy_wraps_bearings(x64):
    """Behind the radar, where bearings jump from pi to -pi, it still agrees with ours."""
    params = Params()
    only = jax.tree.map(lambda leaf: leaf[0], scene.random_scenes(1, 6, 2, 1, params))
    mean = np.array(only.predicted.mean)
    mean[:, 0], mean[:, 2] = -mean[:, 0], 2.0
    own = scene.spherical(mean[:, ::2] * [1, -1, 1])
    assert np.all(scene.spherical(mean[:, ::2])[:, 1] - own[:, 1] > 6.0)
    behind = only.replace(predicted=only.predicted.replace(mean=mean), own=own)
    _, theirs = peers.FilterPy(params).update(behind)
    ours = jax.jit(operations.update)(behind, params)
    assert scene.error(scene.in_order(ours.mean, ours.covariance), theirs) < 1e-9


def test_a_difference_is_seen():
    covariance = np.array([4.0 * np.eye(6)] * 2)
    found = scene.in_order(np.zeros((2, 6)), covariance)
    assert scene.error(found, found) == 0
    moved = np.zeros((2, 6))
    moved[1, 3] = 0.02
    assert scene.error(scene.in_order(moved, covariance), found) == pytest.approx(0.01)
    grown = covariance.copy()
    grown[0, 0, 5] += 0.4
    assert scene.error(scene.in_order(np.zeros((2, 6)), grown), found) == pytest.approx(0.1)
    others = dataclasses.replace(found, labels=[((0, 1), 0), ((0, 2), -1)])
    assert scene.error(others, found) == np.inf
    assert np.isnan(scene.error(scene.in_order(moved * np.nan, covariance), found))


def test_ours_counts_every_scenario_of_the_batch(monkeypatch):
    """Each look at the clock takes a second: two calls fit into 2 s, on two scenarios each."""
    params = Params()
    ours = operations.Ours("predict", scene.random_scenes(2, 3, 2, 0, params), 2, params)
    clock = iter(range(100))
    monkeypatch.setattr(operations.time, "perf_counter", lambda: float(next(clock)))
    alone, each = ours.time(0, min_seconds=3.0)
    assert (alone, each) == (pytest.approx(3 / 2), pytest.approx(3 / 2 / 2))


def test_command_writes_all_and_prints_markdown(rows, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tracker, "measure", lambda *_: rows)
    file = tmp_path / "result.json"
    assert tracker.main(["--out", str(file), "--markdown", "--tracks", "7"]) == 0
    result = json.loads(file.read_text())
    assert {"date", "versions", "machine", "options", "scenario", "rows"} < set(result)
    assert result["rows"] == rows
    assert ("filterpy" in result["versions"]) == peers.has_filterpy()
    assert result["options"]["tracks"] == [7]
    assert str(tmp_path) not in file.read_text()
    said = capsys.readouterr().out
    table = [line for line in said.splitlines() if line.startswith("|")]
    assert len(table) == 2 + len(rows)
    assert len({line.count("|") for line in table}) == 1
    assert "results are the same" in said


@pytest.mark.parametrize("wrong", [1.0, np.inf, np.nan])
def test_different_results_are_told(rows, monkeypatch, capsys, wrong):
    bad = {**rows[0], "largest_difference_sigma": {"stone_soup": wrong}}
    monkeypatch.setattr(tracker, "measure", lambda *_: [*rows[1:], bad])
    assert tracker.main([]) == tracker.DIFFERENT
    assert "DIFFERENT" in capsys.readouterr().out


def test_without_filterpy_its_columns_are_left_out(monkeypatch, capsys):
    monkeypatch.setattr(tracker, "has_filterpy", lambda: False)
    options = dataclasses.replace(OPTIONS, tracks=(3,), repeats=1)
    rows = tracker.measure(options, Params(), Progress(disable=True))
    assert all(set(row["microseconds"]) == {"alone", "batch", "stone_soup"} for row in rows)
    monkeypatch.setattr(tracker, "measure", lambda *_: rows)
    assert tracker.main(["--markdown"]) == 0
    said = capsys.readouterr().out
    assert "FilterPy" not in said.splitlines()[0]
    assert "FilterPy is not installed (extra bench)" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats = 0"),
        (["--tracks", "5", "5"], r"tracks = \(5, 5\): expected different"),
        (["--tracks", "4"], r"tracks = 4: expected an integer in \[5, 200\]"),
        (["--tracks", "201"], r"tracks = 201: expected an integer in \[5, 200\]"),
        (["--detections", "0"], "detections = 0"),
        (["--batch", "1"], "batch = 1"),
        (["--min-seconds", "0"], "min_seconds = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(tracker, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        tracker.main(arguments)
