"""The tracker on a file of detections.

    python -m jaxtrack.track DETECTIONS.csv --out TRACKS.csv

As a function: `jaxtrack.tracking.track_scans`.
"""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from jaxtrack.cli import parse, require_file, run, take_config
from jaxtrack.detection_file import RecordedDetections, read_detections
from jaxtrack.params import (
    ASSOCIATORS,
    COVARIANCE_FORMS,
    DELETERS,
    FILTERS,
    INITIATORS,
    MEASURES,
    Params,
    StaticParams,
)
from jaxtrack.track_file import TrackWriter, partial_path
from jaxtrack.track_plot import SUFFIXES, TrackPaths
from jaxtrack.tracker import DEFAULT
from jaxtrack.tracking import track_scans
from jaxtrack.validation import allowed_range, validate, with_unit

TRACKER_FIELDS = (
    "elevation_sigma",
    "bearing_sigma",
    "range_sigma",
    "process_noise",
    "alpha",
    "beta",
    "kappa",
    "gate_threshold",
    "missed_distance",
    "platform_speed",
    "prior_velocity_sigma",
    "deletion_threshold",
    "deletion_time",
    "deletion_steps",
)
"""The fields of `Params` that the tracker uses on recorded detections."""

TRACKER_CHOICES = {
    "filter": FILTERS,
    "covariance_form": COVARIANCE_FORMS,
    "measure": MEASURES,
    "associator": ASSOCIATORS,
    "deleters": DELETERS,
    "intersect_deleters": ("true", "false"),
    "initiator": INITIATORS,
    "min_points": (),
}
"""The fields of `StaticParams` that it uses, and what they may be."""

HELP = """\
Runs the tracker over recorded detections.
It reads the columns time, elevation, bearing, range (s, rad, rad, m), in any order; others are ignored.
Rows of equal time (to the microsecond) are one scan; a row with only a time is an empty scan.
Intervals may be uneven, and times as large as seconds since 1970.
It writes one row for each live track and scan: time, track (0, 1, ... in order of birth), x, vx, y, vy,
z, vz (m, m/s), the upper triangle p00, p01, ... p55 of their covariance, and detection (row within the
scan, from 0; empty where the scan had none for the track).
--config FILE (.toml or .json) sets numbers and parts of the tracker; --set wins over it.
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the command is to do."""

    detections: tyro.conf.Positional[Path] = tyro.MISSING
    """CSV file to read."""
    out: Path = tyro.MISSING
    """CSV file to write."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A number or part of the tracker as name=value, from the lists above."""
    plot: Path | None = None
    """Picture of the tracks to draw: .png, .pdf or .svg."""


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    values, rest = take_config(argv)
    options = parse(Options(), rest, "python -m jaxtrack.track", help_text())
    values = {**values, **read_settings(options.set)}
    static = build_static({name: value for name, value in values.items() if name in TRACKER_CHOICES})
    params = build_params(
        {name: value for name, value in values.items() if name not in TRACKER_CHOICES}, static
    )
    check_files(options)
    with jax.enable_x64(True):
        recorded = read_detections(options.detections)
        if recorded.ignored:
            print(f"{options.detections}: ignored columns {', '.join(recorded.ignored)}", file=sys.stderr)
        print(track_file(recorded, params, options, static))
    return 0


@dataclasses.dataclass(frozen=True)
class Summary:
    """What was done, and how long it took (s)."""

    out: Path
    scans: int
    detections: int
    tracks: int
    seconds: float
    compile_seconds: float

    def __str__(self) -> str:
        """One line."""
        return (
            f"{self.out}: scans {self.scans:,}, detections {self.detections:,}, tracks {self.tracks:,}; "
            f"{self.seconds:.1f} s, {self.scans / self.seconds:,.0f} scans/s, "
            f"after compiling for {self.compile_seconds:.1f} s"
        )


def track_file(
    recorded: RecordedDetections, params: Params, options: Options, static: StaticParams = DEFAULT
) -> Summary:
    """Tracks, writes, and draws; what is done stays in the partial file if it is interrupted."""
    started, scans, tracks, compiling = time.perf_counter(), 0, 0, 0.0
    paths = TrackPaths(recorded) if options.plot else None
    try:
        with (
            TrackWriter(options.out, recorded.label) as writer,
            _progress() as progress,
            contextlib.closing(track_scans(recorded, params, static=static)) as chunks,
        ):
            task = progress.add_task("tracking", total=len(recorded.time), speed="compiling")
            for rows in chunks:
                writer.write(rows)
                if paths:
                    paths.add(rows)
                scans, tracks, compiling = rows.scans.stop, rows.tracks_born, rows.compile_seconds
                speed = scans / (time.perf_counter() - started - compiling)
                progress.update(task, completed=scans, speed=f"{speed:,.0f} scans/s")
    except KeyboardInterrupt:
        where = partial_path(options.out)
        print(f"the first {scans} of {len(recorded.time)} scans are in {where}", file=sys.stderr)
        raise
    seconds = time.perf_counter() - started - compiling
    if paths and options.plot:
        paths.save(options.plot)
    return Summary(options.out, scans, len(recorded.value), tracks, seconds, compiling)


def build_static(values: dict[str, Any]) -> StaticParams:
    """The tracker's parts with these changed; of words, `deleters` are separated by commas.

    Raises:
        ValueError: naming a field and what it may be.
    """
    parts = dict(values)
    if isinstance(parts.get("deleters"), str):
        parts["deleters"] = tuple(name.strip() for name in parts["deleters"].split(","))
    elif isinstance(parts.get("deleters"), list):
        parts["deleters"] = tuple(parts["deleters"])
    word = parts.get("intersect_deleters")
    if isinstance(word, str) and word.lower() in ("true", "false"):
        parts["intersect_deleters"] = word.lower() == "true"
    if isinstance(parts.get("min_points"), str) and parts["min_points"].isdecimal():
        parts["min_points"] = int(parts["min_points"])
    return StaticParams(**parts)


def build_params(values: dict[str, Any], static: StaticParams = DEFAULT) -> Params:
    """The tracker's numbers with these changed.

    Raises:
        ValueError: naming a field that the tracker does not use, or a value out of range.
    """
    for name, value in values.items():
        if name not in TRACKER_FIELDS:
            known = ", ".join([*TRACKER_FIELDS, *TRACKER_CHOICES])
            raise ValueError(f"{name}: no number of the tracker; expected one of {known}")
        if isinstance(value, (bool, list, dict)) or value is None:
            raise ValueError(f"{name} = {value!r}: expected a number")
    params = Params(**{name: _as_float(value) for name, value in values.items()})
    validate(static, params)
    return params


def _as_float(value: Any) -> Any:
    """As float if it can be one; `validate` names what can not."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return value


def read_settings(settings: Sequence[str]) -> dict[str, str]:
    """Names and values of `--set`.

    Raises:
        ValueError: naming one that has no equals sign.
    """
    for setting in settings:
        if "=" not in setting:
            raise ValueError(f"set = {setting!r}: expected name=value, such as process_noise=10")
    return {name.strip(): value.strip() for name, _, value in (s.partition("=") for s in settings)}


def check_files(options: Options) -> None:
    """Raises ValueError, naming the option, for a file that can not be written or would be lost."""
    taken = [("detections", options.detections.resolve())]
    for name, path in (("out", options.out), ("plot", options.plot)):
        if path is None:
            continue
        require_file(name, path)
        for other, known in taken:
            if known in (path.resolve(), partial_path(path).resolve()):
                raise ValueError(f"{name} = {str(path)!r}: is the file of {other}, which would be lost")
        taken.append((name, path.resolve()))
    if options.plot and options.plot.suffix not in SUFFIXES:
        raise ValueError(f"plot = {str(options.plot)!r}: expected a name that ends in {', '.join(SUFFIXES)}")


def help_text() -> str:
    """What the command does, and the lists of the tracker's numbers and parts."""
    lines = [HELP, "Numbers, with defaults:"]
    for field in dataclasses.fields(Params):
        if field.name in TRACKER_FIELDS:
            default = "unset" if field.default is None else with_unit(f"{field.default:g}", field)
            lines.append(f"  {field.name} = {default}, in {allowed_range(field)}")
    lines.append("Parts, with defaults:")
    for name, choices in TRACKER_CHOICES.items():
        value = getattr(DEFAULT, name)
        text = ",".join(value) if isinstance(value, tuple) else str(value).lower()
        lines.append(f"  {name} = {text}{', of ' + ', '.join(choices) if choices else ''}")
    return "\n".join(lines)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not sys.stderr.isatty(),
        transient=True,
    )


if __name__ == "__main__":
    run(main)
