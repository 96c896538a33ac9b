"""Recorded aircraft: geodesy against known values, files as they come, truths of an environment."""

import math
import os
import re
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxtrack
from jaxtrack.geodesy import Radar, earth_centred, east_north_up, place_radar, to_east_north, to_radar
from jaxtrack.policies import POLICIES
from jaxtrack.recording import record_episode
from jaxtrack.trajectories import AIRCRAFT, Recording, in_view, read_opensky, resample, scenario
from tests.aircraft_file import FLEET, START, fly, state_rows, write_states

REAL_FILE = os.environ.get("JAXTRACK_OPENSKY", "")
HERE = Radar(latitude=51.5, longitude=-0.5)
STILL = np.zeros((1, 3))


@pytest.fixture
def states_file(tmp_path):
    """Writes a file of rows."""
    return lambda rows: write_states(tmp_path / "states.csv", rows)


def place_of(latitude, longitude, altitude=0.0):
    return np.array([[latitude, longitude, altitude]])


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 0.0, 0.0), (6378137.0, 0.0, 0.0)),
        ((0.0, 90.0, 10.0), (0.0, 6378147.0, 0.0)),
        ((90.0, 0.0, 0.0), (0.0, 0.0, 6356752.314245)),
        ((-90.0, 0.0, 5.0), (0.0, 0.0, -6356757.314245)),
        # The worked example of EPSG guidance note 7-2, method 9602.
        (
            (53 + 48 / 60 + 33.820 / 3600, 2 + 7 / 60 + 46.380 / 3600, 73.0),
            (3771793.968, 140253.342, 5124304.349),
        ),
    ],
)
def test_earth_centred_against_known_points(place, expected):
    np.testing.assert_allclose(earth_centred(np.array(place)), expected, atol=1e-3)


def test_up_is_the_change_with_altitude_and_the_axes_are_right_handed():
    place = np.array([51.5, -0.5, 0.0])
    axes = east_north_up(place)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-15)
    risen = earth_centred(place + np.array([0, 0, 1000.0])) - earth_centred(place)
    np.testing.assert_allclose(risen, 1000.0 * axes[2], atol=1e-6)
    assert axes[1][2] > 0, "north has the Earth's axis"


@pytest.mark.parametrize(
    ("heading", "forward", "left"), [(0, 1, 0), (90, 0, 1), (180, -1, 0), (270, 0, -1), (-90, 0, -1)]
)
def test_an_aircraft_in_the_north_by_the_heading_of_the_radar(heading, forward, left):
    radar = Radar(51.5, -0.5, heading=heading)
    state = to_radar(place_of(51.6, -0.5), np.array([[0.0, 100.0, 0.0]]), radar)[0]
    assert state[0] == pytest.approx(11_126 * forward, abs=3)
    assert state[2] == pytest.approx(11_126 * left, abs=3)
    np.testing.assert_allclose(state[[1, 3]], [100 * forward, 100 * left], atol=1e-3)
    assert state[5] < 0, "level flight sinks under a flat horizon"
    np.testing.assert_allclose(to_east_north(state, radar), [0.0, 11_126], atol=3)


def test_the_earth_falls_away_under_the_horizon():
    x, _, z = to_radar(place_of(53.0, -0.5), STILL, HERE)[0, 0::2]
    assert z == pytest.approx(-(x**2) / (2 * 6.38e6), rel=0.01)
    above = to_radar(place_of(51.5, -0.5, 9000.0), STILL, HERE)[0, 0::2]
    np.testing.assert_allclose(above, [0, 0, 9000.0], atol=1e-6)


def test_an_old_position_is_moved_by_its_velocity():
    flight = (52.0, -1.0, 9000.0, 200.0, 60.0, 10.0)
    v = np.array([[200 * math.sin(math.radians(60)), 200 * math.cos(math.radians(60)), 10.0]])
    old = to_radar(np.array([fly(*flight, -1.5)]), v, HERE, age=np.array([1.5]))
    now = to_radar(np.array([fly(*flight, 0.0)]), v, HERE)
    np.testing.assert_allclose(old[0, 0::2], now[0, 0::2], atol=0.1)


@pytest.mark.parametrize(
    ("fields", "name"),
    [((91.0, 0.0), "latitude"), ((0.0, 181.0), "longitude"), ((0, 0, math.nan), "altitude")],
)
def test_a_radar_on_no_earth_is_refused(fields, name):
    with pytest.raises(ValueError, match=f"{name} = .*expected a number in"):
        Radar(*fields)


def test_a_file_is_read(states_file):
    recording = read_opensky(states_file(state_rows(4)), HERE)
    assert recording.ids == tuple(name for name, *_ in FLEET)
    np.testing.assert_array_equal(recording.times, START + 10.0 * np.arange(4))
    assert recording.states.shape == (4, len(FLEET), 6)
    assert np.isfinite(recording.states).all()
    assert recording.left_out == {"stale": 0, "on ground": 0, "incomplete": 0}
    # Positions and velocities belong together: the flights are straight.
    moved = recording.states[2, :, 0::2] - recording.states[0, :, 0::2]
    np.testing.assert_allclose(moved / 20, recording.states[1, :, 1::2], atol=0.05)
    speed = np.linalg.norm(recording.states[0, :, 1::2], axis=-1)
    np.testing.assert_allclose(speed, [math.hypot(row[4], row[6]) for row in FLEET])


def test_what_is_left_out_and_what_stands_in(states_file):
    rows = state_rows(4)
    rows[0]["lastposupdate"] = START - 2.5
    rows[4]["lastposupdate"] = START + 10 - 1.9
    rows[1]["onground"] = "True"
    rows[2]["vertrate"] = ""
    rows[3]["geoaltitude"] = ""
    rows[6]["geoaltitude"] = rows[6]["baroaltitude"] = ""
    rows[7] |= {"icao24": "AAAA04 "}
    repeated = rows[7] | {"geoaltitude": 5000.0}
    recording = read_opensky(states_file([*rows, repeated]), HERE)
    absent = np.isnan(recording.states).any(axis=-1)
    assert {tuple(map(int, where)) for where in np.argwhere(absent)} == {(0, 0), (0, 1), (0, 2), (1, 2)}
    assert np.isnan(recording.states[absent]).all()
    assert recording.left_out == {"stale": 1, "on ground": 1, "incomplete": 2}
    plain = read_opensky(states_file(state_rows(4)), HERE).states
    # The barometric altitude of these files is 100 m lower; of two rows the later counts.
    assert np.linalg.norm(recording.states[0, 3] - plain[0, 3]) == pytest.approx(100, abs=0.1)
    assert np.linalg.norm(recording.states[1, 3] - plain[1, 3]) == pytest.approx(6000, abs=1)
    older = read_opensky(states_file(rows), HERE, max_age=3.0)
    assert older.left_out["stale"] == 0


@pytest.mark.parametrize(
    ("field", "text", "words"),
    [
        ("lat", "north", r"lat = 'north': expected a number in \[-90, 90\]"),
        ("lat", "90.5", r"lat = '90.5': expected a number in \[-90, 90\]"),
        ("lon", "-181", r"lon = '-181': expected"),
        ("velocity", "-1", r"velocity = '-1': expected a number in \[0, inf\]"),
        ("geoaltitude", "inf", "geoaltitude = 'inf': expected"),
        ("time", "nan", "time = 'nan': expected"),
        ("onground", "maybe", "onground = 'maybe': expected True or False"),
    ],
)
def test_a_malformed_row_is_named_by_file_and_line(states_file, field, text, words):
    rows = state_rows(2)
    rows[2][field] = text
    with pytest.raises(ValueError, match=r"states\.csv, line 4: " + words):
        read_opensky(states_file(rows))


def test_a_row_with_too_few_or_too_many_fields_is_named(states_file):
    for edit in (lambda line: line.rpartition(",")[0], lambda line: line + ",7"):
        path = states_file(state_rows(2))
        lines = path.read_text().splitlines()
        lines[3] = edit(lines[3])
        path.write_text("\n".join(lines))
        with pytest.raises(ValueError, match=r"states\.csv, line 4: number of fields"):
            read_opensky(path)


def test_files_without_columns_or_reports_are_refused(tmp_path, states_file):
    path = tmp_path / "other.csv"
    path.write_text("time,lat,longitude\n1,2,3\n")
    with pytest.raises(ValueError, match=r"other\.csv: missing columns: lon, velocity, .*icao24"):
        read_opensky(path)
    path.write_text("")
    with pytest.raises(ValueError, match="missing columns"):
        read_opensky(path)
    with pytest.raises(ValueError, match="no usable report"):
        read_opensky(states_file([]))
    with pytest.raises(ValueError, match="max_age = -1"):
        read_opensky(states_file(state_rows(1)), max_age=-1)


def test_resampling_meets_the_reports_and_flies_straight_between(states_file):
    recording = read_opensky(states_file(state_rows(4)), HERE)
    finer = resample(recording, time_step=2.5, num_steps=10, start=5.0)
    assert finer.shape == (11, len(FLEET), 6)
    np.testing.assert_allclose(finer[2], recording.states[1], rtol=1e-12)
    np.testing.assert_allclose(finer[6], recording.states[2], rtol=1e-12)
    halfway = (recording.states[1] + recording.states[2]) / 2
    np.testing.assert_allclose(finer[4], halfway, atol=1.0)
    # The velocity is the derivative of the position.
    change = (finer[2:, :, 0::2] - finer[:-2, :, 0::2]) / 5.0
    np.testing.assert_allclose(change, finer[1:-1, :, 1::2], atol=0.05)


def test_a_turn_is_interpolated_with_the_reported_velocities():
    """Quarter circle of 1000 m radius in 10 s: the middle of a straight line lies 293 m inside."""
    turn = np.zeros((2, 1, 6))
    speed = 1000 * (math.pi / 2) / 10
    turn[0, 0, [0, 3]], turn[1, 0, [2, 1]] = (1000, speed), (1000, -speed)
    recording = recording_of(np.array([0.0, 10.0]), turn)
    middle = resample(recording, 5.0, 2)[1, 0]
    assert np.hypot(middle[0], middle[2]) == pytest.approx(1000, abs=20)
    assert middle[0] == pytest.approx(middle[2])


def recording_of(times, states):
    """A recording of given states `[K, N, 6]`."""
    return Recording(times, tuple("abcdefg"[: states.shape[1]]), states, HERE, {})


def test_nothing_is_made_up_where_there_are_no_reports():
    times = np.arange(0.0, 90.0, 10.0)
    states = np.zeros((9, 4, 6))
    states[:, :, 0], states[:, :, 1] = 100 * times[:, None], 100.0
    states[3:5, 0] = np.nan  # 30 s between reports: flown through
    states[2:5, 1] = np.nan  # 40 s: absent
    states[:2, 2] = states[7:, 2] = np.nan  # comes and goes
    states[1:, 3] = np.nan  # one report
    finer = resample(recording_of(times, states), 5.0, 16)
    alive = np.isfinite(finer).all(axis=-1)
    assert np.isfinite(finer).any(axis=-1).tolist() == alive.tolist(), "a state is whole or absent"
    assert alive[:, 0].all()
    np.testing.assert_allclose(finer[:, 0, 0], 100 * 5.0 * np.arange(17))
    assert np.flatnonzero(~alive[:, 1]).tolist() == list(range(2, 10)), "until the next report"
    assert np.flatnonzero(alive[:, 2]).tolist() == list(range(4, 13))
    assert not alive[:, 3].any()


def test_reports_that_contradict_one_another_are_not_joined():
    times = np.arange(0.0, 40.0, 10.0)
    states = np.zeros((4, 2, 6))
    states[2, 0, 4] = 900.0
    states[2, 1, 4] = 1100.0
    alive = np.isfinite(resample(recording_of(times, states), 5.0, 6)).all(axis=-1)
    assert alive[:, 0].all()
    assert alive[:2, 1].all()
    assert not alive[2:6, 1].any()


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"time_step": 0.0}, "time_step = 0.0"),
        ({"num_steps": 0}, "num_steps = 0"),
        ({"max_gap": -1.0}, "max_gap = -1.0"),
        ({"start": -1.0}, "start = -1.0"),
        ({"start": 25.0}, "30 s of the recording"),
        ({"num_steps": 31}, "30 s of the recording"),
    ],
)
def test_an_episode_must_lie_in_the_recording(states_file, numbers, words):
    recording = read_opensky(states_file(state_rows(4)), HERE)
    with pytest.raises(ValueError, match=words):
        resample(recording, **{"time_step": 1.0, "num_steps": 10, **numbers})


def test_out_of_view_is_absent():
    here = [[50e3, 0, 0, 0, 5e3, 0], [-50e3, 0, 0, 0, 5e3, 0], [50e3, 0, 0, 0, -1.0, 0]]
    here += [[50e3, 0, 49e3, 0, 5e3, 0], [50e3, 0, 51e3, 0, 5e3, 0], [301e3, 0, 0, 0, 5e3, 0]]
    here += [[1e3, 0, 0, 0, 1.1e3, 0], [np.nan] * 6]
    seen = in_view(np.array([here]), field_limit=math.pi / 4, max_range=300e3)[0]
    assert np.isfinite(seen).all(axis=-1).tolist() == [True, False, False, True, False, False, False, False]
    np.testing.assert_array_equal(seen[0], here[0])


def test_the_default_radar_has_the_aircraft_in_front_and_above_the_horizon(states_file):
    recording = read_opensky(states_file(state_rows(4)))
    kept = in_view(recording.states, AIRCRAFT["field_limit"], AIRCRAFT["max_range"])
    np.testing.assert_array_equal(kept, recording.states)


def test_the_default_radar_counts_only_what_is_above_its_horizon():
    """Five low aircraft, of which a radar sees one at most (62 km), and three high ones further off."""
    low = [[50.0, longitude, 300.0] for longitude in range(5)]
    places = np.array(low + [[52.0, longitude, 9000.0] for longitude in (0.0, 0.5, 1.0)])
    radar = place_radar(places, 1.05, 300e3)
    seen = np.isfinite(in_view(to_radar(places, places * 0, radar), 1.05, 300e3)).all(axis=-1)
    assert seen[5:].all()
    assert seen[:5].sum() == 1


@pytest.mark.usefixtures("quick_compilation")
def test_aircraft_are_the_truths_of_an_environment(states_file):
    rows = state_rows(6)
    gone = [row for row in rows if not (row["icao24"] == "aaaa02" and row["time"] < START + 20)]
    recording = read_opensky(states_file(gone))
    fields = scenario(recording, num_steps=300, map_size=12)
    env, params = jaxtrack.make(**fields)
    assert (env.static.num_truths, params.time_step, params.max_steps_in_episode) == (4, 0.1, 300)
    episode = record_episode(env, params, POLICIES["index"](env.static, params), jax.random.key(0))
    alive = episode.states.truths.alive
    assert (alive[:198].sum(axis=1) == 3).all()
    assert alive[200:].all()
    flown = np.where(np.isnan(fields["trajectories"][1:]), 0.0, fields["trajectories"][1:])
    np.testing.assert_allclose(episode.states.truths.state, flown, rtol=1e-5, atol=0.05)
    assert episode.completeness[-10:].mean() > 0.7


def test_a_scenario_needs_an_aircraft_in_view(states_file):
    recording = read_opensky(states_file(state_rows(4)), Radar(40.0, 0.0))
    with pytest.raises(ValueError, match="no aircraft in view of Radar"):
        scenario(recording, num_steps=10)


@pytest.mark.skipif(not REAL_FILE, reason="JAXTRACK_OPENSKY names no file")
def test_a_recorded_file():
    recording = read_opensky(REAL_FILE)
    present = np.isfinite(recording.states).all(axis=-1)
    assert present.sum() > 0.5 * sum(recording.left_out.values())
    speed = np.linalg.norm(recording.states[present][:, 1::2], axis=-1)
    assert np.median(speed) == pytest.approx(170, abs=80)
    fields = scenario(recording, num_steps=100, start=20.0)
    assert fields["num_truths"] >= 3
    # What was read is consistent: a report leads to the next one.
    straight = recording.states[1:, :, 0::2] - recording.states[:-1, :, 0::2]
    straight -= (
        np.diff(recording.times)[:, None, None]
        * (recording.states[1:] + recording.states[:-1])[..., 1::2]
        / 2
    )
    assert np.nanmedian(np.linalg.norm(straight, axis=-1)) < 20


@pytest.mark.skipif(not REAL_FILE, reason="JAXTRACK_OPENSKY names no file")
def test_the_pages_block_runs(tmp_path, monkeypatch, capsys):
    page = Path(__file__).parents[1] / "docs" / "real_aircraft.md"
    (block,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, str(page), "exec"), {"__name__": "__main__"})
    assert "completeness" in capsys.readouterr().out
    assert (tmp_path / "aircraft.png").stat().st_size > 10_000
