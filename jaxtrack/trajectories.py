"""Recorded aircraft as truths: OpenSky state vectors seen from a radar on the ground.

The truths of an environment are

    recording = read_opensky("states.csv")
    env, params = jaxtrack.make(**scenario(recording, num_steps=1000))
"""

import csv
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxtrack.geodesy import Radar, place_radar, to_radar
from jaxtrack.models import elevation_bearing_range
from jaxtrack.types import STATE_DIM

MAX_AGE = 2.0
"""A report whose position is older than this is left out (s)."""
MAX_GAP = 30.0
"""An aircraft is absent between reports further apart than this (s)."""
MAX_JUMP = 1_000.0
"""An aircraft is absent between reports that contradict one another by more than this (m)."""

AIRCRAFT: dict[str, float] = {
    "time_step": 0.1,
    "field_limit": math.pi / 3,
    "min_range": 5_000.0,
    "max_range": 300_000.0,
    "elevation_sigma": math.radians(0.1),
    "bearing_sigma": math.radians(0.1),
    "range_sigma": 150.0,
    "process_noise": 30.0,
    "prior_velocity_sigma": 200.0,
    "deletion_threshold": 2e7,
    "gospa_cutoff": 2_000.0,
    "scan_time_constant": 20.0,
}
"""Fields of `Params` for airliners at up to 300 km and 250 m/s; the reasons are in docs/real_aircraft.md."""

# Column of an OpenSky file and the values it may hold.
_NUMBERS = {
    "time": (-math.inf, math.inf),
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "velocity": (0.0, math.inf),
    "heading": (-360.0, 360.0),
    "vertrate": (-math.inf, math.inf),
    "geoaltitude": (-math.inf, math.inf),
    "baroaltitude": (-math.inf, math.inf),
    "lastposupdate": (-math.inf, math.inf),
}
_COLUMNS = (*_NUMBERS, "icao24", "onground")


class Report(NamedTuple):
    """One usable row of a file: time (s), aircraft, position (deg, deg, m) and velocity.

    `velocity` is east, north and up at the aircraft (m/s); `age` is how much older the position
    is than the row (s).
    """

    time: float
    aircraft: str
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    age: float


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """Aircraft in the platform frame of a radar.

    Attributes:
        times: `[K]` times of the scans, rising (s, Unix time in OpenSky files).
        ids: `[N]` names of the aircraft (ICAO 24-bit addresses), sorted.
        states: `[K, N, 6]` x, vx, y, vy, z, vz (m, m/s); NaN where there is no report.
        radar: where the frame lies.
        left_out: rows not used, by reason: "stale", "on ground", "incomplete".
    """

    times: np.ndarray  # [K]
    ids: tuple[str, ...]
    states: np.ndarray  # [K, N, 6]
    radar: Radar
    left_out: dict[str, int]


def read_opensky(path: str | Path, radar: Radar | None = None, max_age: float = MAX_AGE) -> Recording:
    """Reads OpenSky state vectors (the columns of its `state_vectors_data4` table).

    The altitude is `geoaltitude`, which is above the ellipsoid; where it is empty, the
    barometric one. A position is moved by the reported velocity from `lastposupdate` to the
    row's time. Left out are aircraft on the ground, positions older than `max_age`, and rows
    where a number is empty; of two rows of an aircraft at one time the later in the file counts.

    Args:
        path: CSV file with a header.
        radar: the place to see them from; `place_radar` chooses where not given.
        max_age: oldest position that is used (s).

    Raises:
        ValueError: naming the file and the missing columns, or the file, the line and what is
            wrong there.
        OSError: if the file can not be read.
    """
    if not max_age >= 0:
        raise ValueError(f"max_age = {max_age}: expected a number >= 0 s")
    left_out = {"stale": 0, "on ground": 0, "incomplete": 0}
    reports = list(_reports(Path(path), max_age, left_out))
    if not reports:
        raise ValueError(f"{path}: no usable report; left out: {left_out}")
    places = np.array([report.position for report in reports])
    radar = radar or place_radar(places, AIRCRAFT["field_limit"], AIRCRAFT["max_range"])
    times, row = np.unique([report.time for report in reports], return_inverse=True)
    ids, column = np.unique([report.aircraft for report in reports], return_inverse=True)
    states = np.full((len(times), len(ids), STATE_DIM), np.nan)
    ages = np.array([report.age for report in reports])
    states[row, column] = to_radar(places, np.array([report.velocity for report in reports]), radar, ages)
    return Recording(times, tuple(ids.tolist()), states, radar, left_out)


def resample(
    recording: Recording, time_step: float, num_steps: int, start: float = 0.0, max_gap: float = MAX_GAP
) -> np.ndarray:
    """States at even steps: `[num_steps + 1, N, 6]` for `Params.trajectories`, row 0 for the reset.

    From one report to the next the position is the cubic that has the reported positions and
    velocities (Hermite), and the velocity is its derivative. Nothing is extrapolated: NaN
    before the first report, after the last, and between reports more than `max_gap` apart or
    whose distance differs by more than `MAX_JUMP` from what the mean of both velocities gives
    (some transponders report altitudes kilometres apart).

    Args:
        recording: what was read.
        time_step: (s).
        num_steps: length of the episode.
        start: time of row 0, counted from the first scan (s).
        max_gap: (s).

    Raises:
        ValueError: if a number makes no sense or the episode outlasts the recording.
    """
    if not time_step > 0 or not max_gap > 0 or num_steps < 1:
        raise ValueError(
            f"time_step = {time_step}, max_gap = {max_gap}, num_steps = {num_steps}: expected more than 0"
        )
    duration = recording.times[-1] - recording.times[0]
    if not 0 <= start <= duration - num_steps * time_step + 1e-9:
        raise ValueError(
            f"start = {start}, num_steps = {num_steps}, time_step = {time_step}: expected to lie in the "
            f"{duration:g} s of the recording"
        )
    wanted = start + time_step * np.arange(num_steps + 1)
    times = recording.times - recording.times[0]
    return np.stack(
        [_resample_one(times, recording.states[:, n], wanted, max_gap) for n in range(len(recording.ids))],
        axis=1,
    )


def in_view(trajectories: np.ndarray, field_limit: float, max_range: float) -> np.ndarray:
    """Trajectories `[K, N, 6]` with NaN wherever the aircraft is out of the radar's reach.

    That is beyond `max_range` (m), below the horizon, or outside `field_limit` (rad) in
    azimuth or elevation.
    """
    elevation, azimuth, distance = np.moveaxis(
        np.asarray(elevation_bearing_range(jnp.asarray(trajectories))), -1, 0
    )
    with np.errstate(invalid="ignore"):  # NaN is in no view
        seen = (elevation >= 0) & (elevation <= field_limit) & (abs(azimuth) <= field_limit)
        seen &= distance <= max_range
    return np.where(seen[..., None], trajectories, np.nan)


def scenario(
    recording: Recording, num_steps: int = 1000, start: float = 0.0, **fields: Any
) -> dict[str, Any]:
    """Fields for `jaxtrack.make` that let the aircraft in the radar's view be the truths.

    `AIRCRAFT`, the trajectories, and shapes that hold them; aircraft never in view are left out.

    Args:
        recording: what was read.
        num_steps: length of the episode.
        start: its beginning, counted from the first scan (s).
        **fields: any field of `Params` or `StaticParams`, to change just that.

    Raises:
        ValueError: if no aircraft is in view, or as `resample`.
    """
    fields = {**AIRCRAFT, "max_steps_in_episode": num_steps, **fields}
    trajectories = resample(recording, fields["time_step"], num_steps, start)
    trajectories = in_view(trajectories, fields["field_limit"], fields["max_range"])
    present = np.isfinite(trajectories).all(axis=-1).any(axis=0)
    count = int(present.sum())
    if not count:
        raise ValueError(
            f"start = {start}, num_steps = {num_steps}: no aircraft in view of {recording.radar}"
        )
    shapes = {"num_truths": count, "max_tracks": 2 * count, "max_detections": count}
    return {**shapes, "trajectories": trajectories[:, present], **fields}


def _resample_one(times: np.ndarray, states: np.ndarray, wanted: np.ndarray, max_gap: float) -> np.ndarray:
    """States `[K', 6]` of one aircraft at the wanted times, from its states `[K, 6]`, NaN where absent."""
    from scipy.interpolate import CubicHermiteSpline

    reported = np.isfinite(states).all(axis=-1)
    t, x, v = times[reported], states[reported, 0::2], states[reported, 1::2]
    resampled = np.full((len(wanted), STATE_DIM), np.nan)
    if len(t) < 2:
        return resampled
    gap = np.diff(t)
    jump = np.linalg.norm(np.diff(x, axis=0) - gap[:, None] * (v[:-1] + v[1:]) / 2, axis=-1)
    before = np.clip(np.searchsorted(t, wanted, side="right") - 1, 0, len(t) - 2)
    known = (wanted >= t[0]) & (wanted <= t[-1]) & ((gap <= max_gap) & (jump <= MAX_JUMP))[before]
    path = CubicHermiteSpline(t, x, v)
    resampled[known, 0::2], resampled[known, 1::2] = path(wanted[known]), path(wanted[known], 1)
    return resampled


def _reports(path: Path, max_age: float, left_out: dict[str, int]) -> Iterator[Report]:
    """The usable rows of a file, in order; counts the others."""
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{path}: missing columns: {', '.join(missing)}")
        for row in reader:
            try:
                report = _report(row)
            except ValueError as error:
                raise ValueError(f"{path}, line {reader.line_num}: {error}") from None
            if isinstance(report, str):
                left_out[report] += 1
            elif report.age > max_age:
                left_out["stale"] += 1
            else:
                yield report


def _report(row: dict[str, Any]) -> Report | str:
    """What a row says, or why it is left out.

    Raises:
        ValueError: naming what is malformed.
    """
    if None in row or None in row.values():
        raise ValueError("number of fields: expected as many as in the header")
    if row["onground"].strip().lower() not in ("true", "false"):
        raise ValueError(f"onground = {row['onground']!r}: expected True or False")
    value = {name: _number(name, row[name]) for name in _NUMBERS}
    if row["onground"].strip().lower() == "true":
        return "on ground"
    altitude = value["baroaltitude"] if math.isnan(value["geoaltitude"]) else value["geoaltitude"]
    heading = math.radians(value["heading"])
    east, north = value["velocity"] * math.sin(heading), value["velocity"] * math.cos(heading)
    age = value["time"] - value["lastposupdate"]
    numbers = (value["lat"], value["lon"], altitude, east, north, value["vertrate"], age)
    aircraft = row["icao24"].strip().lower()
    if not aircraft or any(map(math.isnan, numbers)):
        return "incomplete"
    return Report(value["time"], aircraft, numbers[:3], numbers[3:6], age)


def _number(name: str, text: str) -> float:
    """The number of a field; NaN where it is empty."""
    low, high = _NUMBERS[name]
    try:
        number = float(text) if text.strip() else math.nan
        if text.strip() and not (math.isfinite(number) and low <= number <= high):
            raise ValueError
    except ValueError:
        raise ValueError(f"{name} = {text!r}: expected a number in [{low:g}, {high:g}]") from None
    return number
