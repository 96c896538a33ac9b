"""The benchmark of the tracker on a file: complete, and able to see a difference."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from benchmarks import tracking
from jaxtrack import tracking as tracker_on_files
from jaxtrack.detection_file import RecordedDetections

pytestmark = pytest.mark.usefixtures("quick_compilation")

ARGUMENTS = ["--detections", "60", "--targets", "4", "--stone-soup-seconds", "0.02", "--markdown"]


def test_command_writes_all_and_prints_markdown(tmp_path, capsys):
    file = tmp_path / "result.json"
    assert tracking.main([*ARGUMENTS, "--out", str(file)]) == 0
    result = json.loads(file.read_text())
    assert {"date", "versions", "machine", "options", "scenario", "jaxtrack", "stone_soup"} < set(result)
    ours, theirs = result["jaxtrack"], result["stone_soup"]
    assert ours["detections"] == 60
    assert ours["scans_per_second"] / theirs["scans_per_second"] == pytest.approx(result["ratio"])
    seconds = ours["read_seconds"] + ours["track_and_write_seconds"]
    assert ours["detections_per_second"] == pytest.approx(60 / seconds)
    assert theirs["scans"] >= 1
    assert 0 < result["largest_difference_sigma"] < 1e-9
    assert 100 < ours["peak_memory_mb"] < 100_000
    assert str(tmp_path) not in file.read_text()
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert len(lines) == 4
    assert all(line.count("|") == len(tracking.HEADER) + 1 for line in lines)


def test_a_difference_is_seen():
    scans = tracking.synthetic_scans(4, seed=1)
    recorded = RecordedDetections.from_scans(0.1 * np.arange(8), [next(scans) for _ in range(8)])
    with jax.enable_x64(True):
        records, _ = tracking.time_stone_soup(recorded, least_seconds=100.0)
        (rows,) = tracker_on_files.track_scans(recorded, tracking.PARAMS)
    assert len(records) == 8
    assert tracking.largest_difference(iter([rows]), records) < 1e-9
    for name, value in (("track", rows.track + 1), ("detection", rows.detection[::-1])):
        other = dataclasses.replace(rows, **{name: value})
        assert tracking.largest_difference(iter([other]), records) == np.inf
    sigma = np.sqrt(rows.covariance[-1, 0, 0])
    moved = rows.mean.copy()
    moved[-1, 0] += sigma / 100
    other = dataclasses.replace(rows, mean=moved)
    assert tracking.largest_difference(iter([other]), records) == pytest.approx(0.01, rel=1e-6)


def test_the_scene_has_misses_and_clutter():
    scans = tracking.synthetic_scans(20, seed=0)
    counts = [len(next(scans)) for _ in range(200)]
    assert np.mean(counts) == pytest.approx(20 * tracking.DETECTED + tracking.CLUTTER, abs=0.4)
    assert min(counts) < 20 < max(counts)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--detections", "0"], "detections = 0"),
        (["--targets", "0"], "targets = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--stone-soup-seconds", "nan"], "stone_soup_seconds = nan"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(tracking, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        tracking.main(arguments)
