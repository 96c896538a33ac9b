"""Recorded detections: as arrays, and as read from a CSV file with every mistake named by its line."""

import csv
import dataclasses
import math
from array import array
from collections.abc import Iterator, Sequence
from datetime import timedelta
from functools import cached_property
from operator import itemgetter
from pathlib import Path

import numpy as np

COLUMNS = ("time", "elevation", "bearing", "range")
"""Columns of a file of detections, in any order: s, rad, rad, m."""

LATEST = 2.0**33
"""Times beyond this, before or after zero, are refused (s): a float64 knows no microseconds there."""

MICROSECONDS = 10**6
RIGHT, HALF_TURN = math.pi / 2, math.pi


@dataclasses.dataclass(frozen=True)
class RecordedDetections:
    """Detections of S scans, N in all, on the host.

    Attributes:
        time: `[S]` times of the scans (integer microseconds), strictly increasing.
        count: `[S]` number of detections of each scan; zero for an empty one.
        value: `[N, 3]` elevation (rad), bearing (rad), range (m), scan after scan.
        label: `[S]` the times as they were written.
        ignored: columns of the file that were not read.
    """

    time: np.ndarray  # [S] int64
    count: np.ndarray  # [S] int64
    value: np.ndarray  # [N, 3] float64
    label: Sequence[str]
    ignored: Sequence[str] = ()

    @cached_property
    def start(self) -> np.ndarray:
        """`[S]` row of `value` at which each scan begins."""
        return np.cumsum(self.count) - self.count

    @classmethod
    def from_scans(cls, times: Sequence[float], scans: Sequence[np.ndarray]) -> "RecordedDetections":
        """Takes the detections `[D_k, 3]` (rad, rad, m) of scans at `times` (s), D_k = 0 for an empty scan.

        Raises:
            ValueError: if times are not finite or do not increase, if there is not one array for
                each time, or if a detection is impossible.
        """
        if len(times) != len(scans):
            raise ValueError(f"scans: {len(scans)} arrays; expected one for each of the {len(times)} times")
        labels = [repr(float(time)) for time in times]
        time = np.array([microseconds(label) for label in labels], dtype=np.int64)
        if np.any(np.diff(time) <= 0):
            scan = int(np.argmax(np.diff(time) <= 0)) + 1
            raise ValueError(f"times[{scan}] = {times[scan]}: expected more than {times[scan - 1]} s")
        arrays = [np.asarray(scan, dtype=float).reshape(-1, 3) for scan in scans]
        for index, values in enumerate(arrays):
            for row in values:
                try:
                    check_detection(*row)
                except ValueError as error:
                    raise ValueError(f"scans[{index}]: {error}") from None
        count = np.array([len(values) for values in arrays], dtype=np.int64)
        return cls(time, count, np.concatenate([np.zeros((0, 3)), *arrays]), labels)


def read_detections(path: Path) -> RecordedDetections:
    """Reads a file with the columns `COLUMNS`; rows of equal time (to the microsecond) form one scan.

    A row with only a time is an empty scan. Further columns are ignored.

    Raises:
        ValueError: one line that names the file, the line, the value and what was expected.
        OSError: if the file can not be read.
    """
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.reader(file, strict=True)
        try:
            return _read(reader)
        except (ValueError, csv.Error) as error:
            raise ValueError(f"{path}, line {max(1, reader.line_num)}: {error}") from None


def microseconds(text: str) -> int:
    """Whole microseconds of a time in seconds, rounded as by `datetime.timedelta`.

    Raises:
        ValueError: if it is no number, not finite, or beyond `LATEST`.
    """
    try:
        seconds = _number(text)
    except ValueError:
        seconds = math.nan
    if not abs(seconds) <= LATEST:
        hint = "; milliseconds by mistake?" if math.isfinite(seconds) else ""
        raise ValueError(
            f"time = {text.strip()!r}: expected a number of s in [{-LATEST:.3g}, {LATEST:.3g}]{hint}"
        )
    return timedelta(seconds=seconds) // timedelta(microseconds=1)


def check_detection(elevation: float, bearing: float, distance: float) -> None:
    """Raises ValueError, naming the column, for a detection (rad, rad, m) that is impossible."""
    # Asked once for all three: a file has millions of rows.
    if abs(elevation) <= RIGHT and -HALF_TURN <= bearing <= 2 * HALF_TURN and 0 < distance < math.inf:
        return
    if not abs(elevation) <= RIGHT:
        raise ValueError(f"elevation = {elevation}: expected rad in [-pi/2, pi/2]{_degrees(elevation)}")
    if not -HALF_TURN <= bearing <= 2 * HALF_TURN:
        raise ValueError(f"bearing = {bearing}: expected rad in [-pi, 2 pi]{_degrees(bearing)}")
    raise ValueError(f"range = {distance}: expected m in (0, inf)")


def _degrees(angle: float) -> str:
    return "; degrees by mistake?" if math.isfinite(angle) else ""


def _read(reader: Iterator[list[str]]) -> RecordedDetections:
    header = [name.strip() for name in next(reader, [])]
    pick, width = itemgetter(*_places(header)), len(header)
    times, counts, values, labels = array("q"), array("q"), array("d"), list[str]()
    last = None
    for row in reader:
        if not row:
            continue
        if len(row) != width:
            hint = "" if len(row) > 1 else "; an empty scan is a time followed by empty fields"
            raise ValueError(f"{len(row)} fields; expected {width}{hint}")
        time, *fields = pick(row)
        if time != last:
            now, last = microseconds(time), time
            if times and now < times[-1]:
                raise ValueError(f"time = {time.strip()}: runs backwards, from {labels[-1]}")
            if not times or now > times[-1]:
                times.append(now)
                counts.append(0)
                labels.append(time.strip())
        detection = _detection(fields)
        values.extend(detection)
        counts[-1] += bool(detection)
    if not times:
        raise ValueError("no rows below the header; expected at least one scan")
    return RecordedDetections(
        time=np.array(times, dtype=np.int64),
        count=np.array(counts, dtype=np.int64),
        value=np.array(values, dtype=float).reshape(-1, 3),
        label=labels,
        ignored=tuple(name for name in header if name not in COLUMNS),
    )


def _places(header: list[str]) -> list[int]:
    """Place of every one of `COLUMNS` in the header."""
    if not any(header):
        raise ValueError(f"no header; expected the columns {', '.join(COLUMNS)}")
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise ValueError(f"no column {', '.join(missing)} in the header {','.join(header)!r}")
    twice = [name for name in COLUMNS if header.count(name) > 1]
    if twice:
        raise ValueError(f"column {', '.join(twice)} twice in the header {','.join(header)!r}")
    return [header.index(name) for name in COLUMNS]


def _detection(fields: list[str]) -> tuple[float, ...]:
    """Elevation, bearing and range of the fields; nothing if all are empty.

    Raises:
        ValueError: naming the column that is empty, no number, or impossible.
    """
    try:
        elevation, bearing, distance = map(float, fields)
    except ValueError:
        return _empty(fields)
    if "_" in "".join(fields):
        return _empty(fields)
    check_detection(elevation, bearing, distance)
    return elevation, bearing, distance


def _empty(fields: list[str]) -> tuple[()]:
    """Nothing, if all fields are empty; else raises ValueError, naming the first that is wrong."""
    if not any(text.strip() for text in fields):
        return ()
    for name, text in zip(COLUMNS[1:], fields, strict=True):
        if not text.strip():
            raise ValueError(f"{name} is empty; expected all of elevation, bearing, range or none of them")
        try:
            _number(text)
        except ValueError:
            raise ValueError(f"{name} = {text!r}: expected a number") from None
    raise AssertionError("every field is a number")


def _number(text: str) -> float:
    """As float, without Python's grouped digits: 1_000 is a mistake."""
    return float(text if "_" not in text else "")
