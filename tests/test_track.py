"""The command: what it writes, refuses, says, and leaves when it is stopped."""

import csv
import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Params, StaticParams, track, tracking
from jaxtrack.cli import INTERRUPTED, run
from jaxtrack.detection_file import read_detections
from jaxtrack.track_file import HEADER, TrackWriter
from jaxtrack.track_plot import TrackPaths

pytestmark = pytest.mark.usefixtures("quick_compilation", "x64")

SETTINGS = ("--set", "deletion_threshold=3200", "--set", "process_noise=3")
PARAMS = Params(deletion_threshold=3200.0, process_noise=3.0)
TIMES = ("1600000000", "1600000000.100", "1600000000.35", "1600000000.5", "1600000001.1")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A file of five scans of two targets and one false detection, the fourth empty."""
    rng = np.random.default_rng(0)
    targets = np.array([[0.1, 3.1, 3000.0], [0.4, -0.5, 5000.0]])
    lines = ["time,elevation,bearing,range,snr"]
    for scan, time in enumerate(TIMES):
        rows = targets + [2e-3, 2e-3, 5.0] * rng.standard_normal((2, 3))
        if scan == 2:
            rows = np.concatenate([[[0.9, 1.0, 2000.0]], rows])
        lines += (
            [f"{time},{e!r},{b!r},{r!r},7" for e, b, r in rows.tolist()] if scan != 3 else [f"{time},,,,"]
        )
    path = tmp_path_factory.mktemp("recorded") / "detections.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def chunks(recorded):
    """The rows of the file as the function gives them."""
    with jax.enable_x64(True):
        return list(tracking.track_scans(read_detections(recorded), PARAMS))


@pytest.fixture
def one_call(monkeypatch, chunks):
    """Lets the command take the rows that were computed already."""
    monkeypatch.setattr(track, "track_scans", lambda *_, **__: (rows for rows in chunks))


def test_the_file_holds_every_row_exactly(recorded, chunks, tmp_path, capsys):
    out = tmp_path / "tracks.csv"
    out.write_text("old")
    with jax.enable_x64(False):
        assert track.main([str(recorded), "--out", str(out), *SETTINGS]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["tracks.csv"]
    (rows,) = chunks
    with open(out, newline="") as file:
        header, *lines = csv.reader(file)
    assert tuple(header) == HEADER
    assert ",".join(header) == (
        "time,track,x,vx,y,vy,z,vz,p00,p01,p02,p03,p04,p05,p11,p12,p13,p14,p15,"
        "p22,p23,p24,p25,p33,p34,p35,p44,p45,p55,detection"
    )
    assert [line[0] for line in lines] == [TIMES[scan] for scan in rows.scan]
    assert [int(line[1]) for line in lines] == rows.track.tolist()
    assert [int(line[-1] or NO_DETECTION) for line in lines] == rows.detection.tolist()
    numbers = np.array([[float(field) for field in line[2:-1]] for line in lines])
    np.testing.assert_array_equal(numbers[:, :6], rows.mean)
    column = 6
    for i in range(6):
        for j in range(i, 6):
            np.testing.assert_array_equal(numbers[:, column], rows.covariance[:, i, j])
            column += 1
    said = capsys.readouterr()
    assert said.err == f"{recorded}: ignored columns snr\n"
    assert said.out.startswith(f"{out}: scans 5, detections 9, tracks 3; ")
    assert "scans/s, after compiling for" in said.out
    assert said.out.count("\n") == 1


def test_the_scenario_has_updates_misses_births_and_deletions(chunks):
    (rows,) = chunks
    alive = {scan: rows.track[rows.scan == scan].tolist() for scan in range(5)}
    assert alive == {0: [0, 1], 1: [0, 1], 2: [0, 1, 2], 3: [0, 1, 2], 4: [0, 1]}
    assert rows.detection.tolist() == [0, 1, 0, 1, 1, 2, 0, -1, -1, -1, 0, 1]


def test_a_file_without_detections(tmp_path, capsys):
    recorded, out, plot = (tmp_path / name for name in ("in.csv", "out.csv", "out.svg"))
    recorded.write_text("time,elevation,bearing,range\n0,,,\n0.5,,,\n")
    assert track.main([str(recorded), "--out", str(out), "--plot", str(plot)]) == 0
    assert out.read_text() == ",".join(HEADER) + "\n"
    assert "scans 2, detections 0, tracks 0; " in capsys.readouterr().out
    assert plot.read_text().startswith("<?xml")


def test_the_fields_are_exactly_those_that_the_tracker_uses(recorded):
    detections = read_detections(recorded)

    def numbers(params, **parts):
        chunks = list(tracking.track_scans(detections, params, static=StaticParams(**parts)))
        return [
            np.concatenate([getattr(c, n).ravel() for c in chunks])
            for n in ("track", "covariance", "detection")
        ]

    quantities = [field.name for field in dataclasses.fields(Params) if field.metadata]
    # min_range only fills rows that are empty.
    # A known turn needs even steps and is refused.
    with pytest.raises(ValueError, match=r"^platform_turn_rate = 0.1: expected None with recorded scans"):
        numbers(Params(platform_turn_rate=0.1))
    unused = set(quantities) - set(track.TRACKER_FIELDS) - {"min_range", "platform_turn_rate"}
    plain = Params(deletion_threshold=3200.0)
    for ours, theirs in zip(
        numbers(plain.replace(**dict.fromkeys(unused, math.nan))), numbers(plain), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    changes = {
        "deletion_threshold": 1e6,
        "gate_threshold": 1e-3,
        "missed_distance": 1e-3,
        "platform_speed": 9.0,
    }
    parts = {
        "deletion_time": {"deleters": ("update_time",)},
        "deletion_steps": {"deleters": ("update_time_steps",)},
    }
    for name, part in parts.items():
        short = 1 if name == "deletion_steps" else 0.01
        long, short = (numbers(plain.replace(**{name: value}), **part) for value in (100, short))
        assert len(long[0]) > len(short[0])
    for name in sorted(set(track.TRACKER_FIELDS) - parts.keys()):
        changed = plain.replace(**{name: changes.get(name, 1.1 * getattr(plain, name))})
        pairs = zip(numbers(changed), numbers(plain), strict=True)
        assert not all(np.array_equal(ours, theirs) for ours, theirs in pairs), name


def test_ctrl_c_leaves_the_scans_done(recorded, chunks, tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        yield from chunks
        raise KeyboardInterrupt

    monkeypatch.setattr(track, "track_scans", interrupted)
    out = tmp_path / "tracks.csv"
    out.write_text("old")
    monkeypatch.setattr("sys.argv", ["track", str(recorded), "--out", str(out)])
    with pytest.raises(SystemExit) as stop:
        run(track.main)
    assert stop.value.code == INTERRUPTED == 130
    assert out.read_text() == "old"
    lines = (tmp_path / "tracks.csv.partial").read_text().splitlines()
    assert len(lines) == 1 + len(chunks[0].track)
    assert f"the first 5 of 5 scans are in {out}.partial\ninterrupted\n" in capsys.readouterr().err


@pytest.mark.usefixtures("one_call")
def test_the_bar_says_what_it_waits_for(recorded, tmp_path, monkeypatch):
    said = []

    class Spy(track.Progress):
        def add_task(self, *words, **fields):
            said.append(fields["speed"])
            return super().add_task(*words, **fields)

        def update(self, task, **fields):
            said.append(fields["speed"])

    monkeypatch.setattr(track, "Progress", Spy)
    track.main([str(recorded), "--out", str(tmp_path / "tracks.csv")])
    assert said[0] == "compiling"
    assert said[1].endswith(" scans/s")


def test_a_row_that_was_cut_is_removed(recorded, chunks, tmp_path):
    def stopped_while_writing():
        with TrackWriter(tmp_path / "tracks.csv", TIMES) as writer:
            writer.write(chunks[0])
            writer.file.write(b"1600000001.1,7,12.")
            writer.file.flush()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped_while_writing()
    (partial,) = tmp_path.iterdir()
    assert partial.name == "tracks.csv.partial"
    text = partial.read_text()
    assert text.endswith("\n")
    assert text.count("\n") == 1 + len(chunks[0].track)


@pytest.mark.usefixtures("one_call")
@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF")])
def test_the_plot_is_written(recorded, tmp_path, suffix, start):
    plot = tmp_path / f"tracks{suffix}"
    assert track.main([str(recorded), "--out", str(tmp_path / "o.csv"), "--plot", str(plot)]) == 0
    assert plot.read_bytes().startswith(start)


def test_the_plot_shows_every_track_and_detection(recorded, chunks, monkeypatch):
    paths = TrackPaths(read_detections(recorded))
    for rows in chunks:
        paths.add(rows)
    brief, lines = paths.lines()
    (rows,) = chunks
    mine = rows.track == 2
    np.testing.assert_allclose(brief[:-1, 0], [0.35, 0.5])
    np.testing.assert_array_equal(brief[:-1, 1:], rows.mean[mine][:, ::2])
    assert np.isnan(brief[-1]).all()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(lines[:, 0])), [5, 11])
    np.testing.assert_array_equal(lines[:5, 1:], rows.mean[rows.track == 0][:, ::2])
    dots = paths.dots()
    np.testing.assert_allclose(dots[:, 0], [0, 0, 0.1, 0.1, 0.35, 0.35, 0.35, 1.1, 1.1])
    np.testing.assert_allclose(np.linalg.norm(dots[:, 1:], axis=1), paths.recorded.value[:, 2])
    monkeypatch.setattr("jaxtrack.track_plot.DOTS", 4)
    assert len(paths.dots()) == 3
    above, height = paths.draw().axes
    assert above.get_aspect() == 1.0
    assert above.get_xlabel() == "x, forward (km)"
    assert above.get_title() == "from above: 3 tracks"
    assert height.get_title() == "height: 9 detections, 3 drawn"


def test_the_command_does_not_import_matplotlib():
    code = "import sys, jaxtrack.track; print('matplotlib' in sys.modules, 'gymnax' in sys.modules)"
    root = Path(__file__).resolve().parents[1]
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert result.stdout.split() == ["False", "False"]
