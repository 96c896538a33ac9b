"""Aircraft through the virtual radar: the same tracks in Stone Soup, and a report that can be trusted."""

import dataclasses
import json
import os

import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Detections, Params
from jaxtrack.detection_file import read_detections
from jaxtrack.geodesy import Radar
from jaxtrack.track import build_params
from jaxtrack.trajectories import read_opensky
from jaxtrack.types import NO_TRUTH
from reference.opensky import ROUNDING, Options, check, main, tracker_params
from reference.parity.compare import TOLERANCE
from reference.parity.episodes import compare_records
from reference.side_by_side import judge, run_jaxtrack, run_stone_soup
from reference.virtual_radar import observe_aircraft, scan_interval
from tests.aircraft_file import FLEET, INTERVAL, state_rows, write_states

REAL_FILE = os.environ.get("JAXTRACK_OPENSKY", "")
SCANS = 8

pytestmark = pytest.mark.usefixtures("quick_compilation")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Straight flights; one jumps half a degree north, where a new track begins."""
    rows = state_rows(SCANS, FLEET)
    for row in rows:
        if row["icao24"] == "aaaa03" and row["time"] >= rows[0]["time"] + 5 * INTERVAL:
            row["lat"] += 0.5
    return write_states(tmp_path_factory.mktemp("opensky") / "states.csv", rows)


@pytest.fixture(scope="module")
def recording(path):
    return read_opensky(path)


@pytest.fixture(scope="module")
def params():
    return tracker_params(Options(path=None), INTERVAL)


@pytest.fixture(scope="module")
def detections(recording, params):
    return observe_aircraft(recording, SCANS, params, clutter=0.0, seed=0)


@pytest.fixture(scope="module")
def ours(detections, params):
    return run_jaxtrack(detections, params)


@pytest.fixture(scope="module")
def theirs(detections, params):
    return run_stone_soup(detections, params, exact_jacobian=True, progress=False)


def test_the_same_tracks_on_both_sides(ours, theirs):
    compared = compare_records(ours.records, theirs.records, TOLERANCE)
    assert compared.divergence is None
    assert 0 < compared.mean_error < TOLERANCE
    assert 0 < compared.covariance_error < TOLERANCE
    # Four tracks of all scans, and a fifth one from the sixth scan on.
    assert (compared.steps, compared.births) == (SCANS, 5)
    assert compared.updates == 4 * SCANS - 5
    assert compared.agreement == 1.0


def test_the_tracks_are_the_aircraft(ours, detections, recording):
    quality = judge(ours.records, detections, recording.states)
    assert (quality.tracks, quality.updated_tracks, quality.aircraft, quality.purity) == (5, 5, 4, 1.0)
    assert 20 < quality.position_rmse < 400


def test_detections_are_the_aircraft_with_the_radars_noise(recording):
    params = Params(time_step=INTERVAL, elevation_sigma=1e-3, bearing_sigma=2e-3, range_sigma=100.0)
    found = observe_aircraft(recording, SCANS, params, clutter=0.0, seed=1)
    truth = observe_aircraft(
        recording,
        SCANS,
        params.replace(elevation_sigma=1e-12, bearing_sigma=1e-12, range_sigma=1e-9),
        clutter=0.0,
        seed=1,
    )
    assert found.truth.tolist() == [[0, 1, 2, 3]] * SCANS
    assert found.active.all()
    offsets = (found.value - truth.value) / [1e-3, 2e-3, 100.0]
    np.testing.assert_allclose(offsets.reshape(-1, 3).std(axis=0), 1.0, atol=0.35)
    seen = truth.value
    ground = seen[..., 2] * np.cos(seen[..., 0])
    points = [
        ground * np.cos(seen[..., 1]),
        ground * np.sin(seen[..., 1]),
        seen[..., 2] * np.sin(seen[..., 0]),
    ]
    np.testing.assert_allclose(np.stack(points, axis=-1), recording.states[..., 0::2], atol=1e-4)


def test_misses_and_clutter(recording, params):
    found = observe_aircraft(recording, SCANS, params.replace(detection_probability=0.7), clutter=3.0, seed=2)
    real = found.active & (found.truth != NO_TRUTH)
    false = found.active & (found.truth == NO_TRUTH)
    assert 15 <= real.sum() <= 29 < 4 * SCANS
    assert 15 <= false.sum() <= 33
    assert (found.value[~found.active] == 0).all()
    low, high = (bound(found.value[real], axis=0) for bound in (np.min, np.max))
    span = high - low
    assert ((found.value[false] > low - span) & (found.value[false] < high + span)).all()
    again = observe_aircraft(recording, SCANS, params.replace(detection_probability=0.7), clutter=3.0, seed=2)
    assert np.array_equal(found.value, again.value)


def test_track_slots_grow_until_nothing_is_dropped(params):
    """One detection per scan, always elsewhere: three tracks, though two slots are tried first."""
    value = np.array([[[0.0, bearing, 5e4]] for bearing in (-2, 0, 2)])
    found = Detections(value, np.ones((3, 1), bool), np.zeros((3, 1), int))
    records = run_jaxtrack(found, params.replace(deletion_threshold=1e9)).records
    assert [len(record.live) for record in records] == [1, 2, 3]


def test_a_different_estimate_is_named(ours):
    key = (1, 2)
    estimate = ours.records[3].live[key]
    covariance = estimate.covariance.copy()
    covariance[4, 1] += 1e-6 * np.sqrt(covariance[4, 4] * covariance[1, 1])
    changed = [*ours.records]
    off = {**changed[3].live, key: dataclasses.replace(estimate, covariance=covariance)}
    changed[3] = dataclasses.replace(changed[3], live=off)
    compared = compare_records(changed, ours.records, TOLERANCE)
    assert str(compared.divergence).startswith(
        "step 4, track born on step 1 from 2: covariance[4, 1] (1.0e-06 sigma apart) ours "
    )
    assert compared.agreement < 1
    assert compare_records(changed, ours.records, np.inf).divergence is None


def test_purity_counts_what_a_track_took_from_other_aircraft(ours, detections, recording):
    swapped = detections.truth.copy()
    swapped[3, [0, 1]] = swapped[3, [1, 0]]
    swapped[4, 3] = NO_TRUTH
    total = 4 * SCANS
    quality = judge(ours.records, detections.replace(truth=jnp.asarray(swapped)), recording.states)
    assert quality.purity == pytest.approx(1 - 3 / total)


def test_the_command(path, tmp_path, capsys):
    out = tmp_path / "made" / "here"
    assert main([str(path), "--out", str(out), "--scans", "4", "--seed", "3"]) == 0
    said = capsys.readouterr().out
    assert f"{SCANS} scans, 4 aircraft; rows left out: 0 stale, 0 on ground, 0 incomplete" in said
    assert "first difference" not in said
    for name in ("jaxtrack", "exact Jacobian", "stock Jacobian"):
        assert name in said
    figures = json.loads((out / "opensky.json").read_text())
    ours, exact, stock = figures["results"]
    assert (ours["tracks"], exact["tracks"], stock["tracks"]) == (4, 4, 4)
    assert exact["agreement"] == stock["agreement"] == 1.0
    assert exact["covariance_error"] < TOLERANCE < stock["covariance_error"] < 1e-2
    assert figures["options"]["seed"] == 3
    assert (out / "opensky.png").read_bytes().startswith(b"\x89PNG")
    check_files_for_the_track_command(out, path)


def check_files_for_the_track_command(out, path):
    """Its reader must get the very numbers that both trackers got here."""
    made = observe_aircraft(read_opensky(path), 4, tracker_params(Options(path=path), INTERVAL), 0.0, 3)
    read = read_detections(out / "detections.csv")
    np.testing.assert_array_equal(read.value, made.value.reshape(-1, 3))
    assert read.time.tolist() == [1_000_000 * INTERVAL * k for k in range(4)]
    assert read.count.tolist() == [4] * 4
    numbers = build_params(json.loads((out / "tracker.json").read_text()))
    assert numbers.replace(time_step=INTERVAL) == tracker_params(Options(path=path), INTERVAL)


def test_an_empty_scan_is_a_row_with_a_time_only(path, tmp_path):
    argv = [
        str(path),
        "--out",
        str(tmp_path),
        "--no-stone-soup",
        "--detection-probability",
        "0.1",
        "--seed",
        "1",
    ]
    assert main(argv) == 0
    lines = (tmp_path / "detections.csv").read_text().split()[1:]
    assert sorted({float(line.split(",")[0]) for line in lines}) == [10.0 * k for k in range(SCANS)]
    assert 0 in read_detections(tmp_path / "detections.csv").count


def test_scans_must_be_even(recording):
    assert scan_interval(recording) == INTERVAL
    times = recording.times.copy()
    times[3:] += 5
    with pytest.raises(ValueError, match=r"15\.0 s before scan 4: expected at least two scans, evenly"):
        scan_interval(dataclasses.replace(recording, times=times))
    with pytest.raises(ValueError, match="one scan only"):
        scan_interval(dataclasses.replace(recording, times=times[:1]))


@pytest.mark.parametrize(("name", "value"), [("scans", -1), ("scans", 1), ("seed", -2), ("clutter", -0.5)])
def test_options_that_make_no_sense_are_named(path, name, value):
    with pytest.raises(ValueError, match=f"{name} = {value}"):
        check(Options(path=path, **{name: value}))


def test_a_number_out_of_range_is_named(path):
    with pytest.raises(ValueError, match="range_sigma = -1"):
        main([str(path), "--range-sigma", "-1"])


def test_bearings_jump_behind_the_radar(path, params):
    """The same aircraft behind the radar, where bearings jump between -pi and pi."""
    behind = read_opensky(path, Radar(52.2, 4.0, heading=90.0))
    found = observe_aircraft(behind, SCANS, params, clutter=1.0, seed=0)
    bearings = found.value[found.active][:, 1]
    assert bearings.min() < -2.9
    assert bearings.max() > 2.9
    theirs = run_stone_soup(found, params, True, False)
    compared = compare_records(run_jaxtrack(found, params).records, theirs.records, ROUNDING)
    assert compared.divergence is None


@pytest.mark.skipif(not REAL_FILE, reason="JAXTRACK_OPENSKY names no file")
def test_a_recorded_file(tmp_path, capsys):
    assert main([REAL_FILE, "--scans", "5", "--out", str(tmp_path)]) == 0
    exact = json.loads((tmp_path / "opensky.json").read_text())["results"][1]
    assert exact["agreement"] == 1.0
    assert exact["tracks"] >= 30
