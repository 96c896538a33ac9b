"""The command's tracks of a recorded file, beside Stone Soup's on the same file, scan by scan."""

import csv
import datetime

import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Params, track
from jaxtrack.track_file import UPPER
from reference.parity.compare import TOLERANCE, covariance_error, mean_error
from reference.parity.scenes import spherical, unit_vectors
from reference.pipeline import StoneSoupTracker

SETTINGS = {"process_noise": 20.0, "deletion_threshold": 4000.0, "gate_threshold": 4.0, "range_sigma": 8.0}
OTHER_PARTS = {
    "filter": "extended",
    "associator": "global_nearest_neighbour",
    "deleters": "update_time,covariance",
    "deletion_time": 0.6,
    "initiator": "multi_measurement",
}
START = 1_600_000_000.0
SCANS = 60

pytestmark = pytest.mark.usefixtures("quick_compilation")


def write_recording(path, seed=0):
    """Seven targets seen at uneven times, with noise, misses, clutter and empty scans."""
    rng = np.random.default_rng(seed)
    # Behind the radar, so that bearings jump.
    azimuth, elevation = np.pi + rng.uniform(-0.3, 0.3, 7), rng.uniform(-0.2, 1.3, 7)
    position = rng.uniform(2000, 6000, (7, 1)) * unit_vectors(azimuth, elevation)
    velocity = 30 * rng.standard_normal((7, 3))
    time, lines = START, ["bearing,range,time,elevation"]
    for scan in range(SCANS):
        time = round(time + float(rng.choice([0.05, 0.1, 0.3, 1 / 3])), 7)
        lines.append(f",,{time!r},")
        if scan % 9 == 5:
            continue
        seen = spherical((position + velocity * (time - START))[rng.random(7) < 0.8])
        seen += [2e-3, 2e-3, 8.0] * rng.standard_normal(seen.shape)
        clutter = rng.uniform([-0.5, 2.0, 500], [1.5, 4.0, 6000], (rng.poisson(0.7), 3))
        rows = np.concatenate([seen, clutter]).tolist()
        lines += [f"{bearing!r},{distance!r},{time!r},{elevation!r}" for elevation, bearing, distance in rows]
    path.write_text("\n".join(lines) + "\n")


def read_scans(path):
    """Time as written and detections `[D, 3]` of each scan, read independently."""
    scans = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            values = scans.setdefault(row["time"], [])
            if row["range"]:
                values.append([float(row[name]) for name in ("elevation", "bearing", "range")])
    return {time: np.array(values).reshape(-1, 3) for time, values in scans.items()}


def read_tracks(path):
    """Rows of each time: track, mean `[6]`, covariance `[6, 6]`, detection."""
    scans = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            mean = np.array([float(row[name]) for name in ("x", "vx", "y", "vy", "z", "vz")])
            covariance = np.zeros((6, 6))
            for i, j in zip(*UPPER, strict=True):
                covariance[i, j] = covariance[j, i] = float(row[f"p{i}{j}"])
            source = int(row["detection"]) if row["detection"] else NO_DETECTION
            scans.setdefault(row["time"], []).append((int(row["track"]), mean, covariance, source))
    return scans


@pytest.mark.parametrize("parts", [{}, OTHER_PARTS], ids=["default", "other parts"])
def test_the_file_of_tracks_is_stone_soups(parts, tmp_path, capsys):
    recorded, written = tmp_path / "detections.csv", tmp_path / "tracks.csv"
    write_recording(recorded)
    settings = [
        word for name, value in {**SETTINGS, **parts}.items() for word in ("--set", f"{name}={value}")
    ]
    assert track.main([str(recorded), "--out", str(written), *settings]) == 0
    ours = read_tracks(written)
    chosen = {name: value for name, value in parts.items() if name in track.TRACKER_CHOICES}
    numbers = {name: value for name, value in parts.items() if name not in chosen}
    static = track.build_static(chosen)
    oracle = StoneSoupTracker(Params(**SETTINGS, **numbers), intermediates=False, static=static)
    numbers, happened = {}, {"updates": 0, "deletions": 0, "missed": 0}
    for time, value in read_scans(recorded).items():
        moment = datetime.datetime(1970, 1, 1) + datetime.timedelta(seconds=float(time))
        theirs = oracle.step(value, time=moment)
        numbers |= {key: len(numbers) + place for place, key in enumerate(sorted(theirs.initiated))}
        expected = sorted((numbers[key], key) for key in theirs.live)
        rows = ours.pop(time, [])
        assert [row[0] for row in rows] == [number for number, _ in expected], f"{time}: live tracks"
        for (_, mean, covariance, source), (number, key) in zip(rows, expected, strict=True):
            estimate = theirs.live[key]
            if not (parts and key in theirs.initiated):  # that of its birth is not the last of several
                assert source == theirs.source(key), f"{time}, track {number}: detection"
            assert mean_error(mean, estimate.mean, estimate.covariance) <= TOLERANCE
            assert covariance_error(covariance, estimate.covariance) <= TOLERANCE
        happened["updates"] += len(theirs.associated)
        happened["deletions"] += len(theirs.deleted)
        happened["missed"] += sum(row[3] == NO_DETECTION for row in rows)
    assert not ours
    assert happened["updates"] > (100 if parts else 150)
    assert min(happened["deletions"], happened["missed"]) > (5 if parts else 20)
    said = capsys.readouterr().out
    assert f"scans {SCANS}, " in said
    assert f"tracks {len(numbers)}; " in said
