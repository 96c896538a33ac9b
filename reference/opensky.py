"""Recorded aircraft through a virtual radar: jaxtrack and stock Stone Soup side by side.

``python -m reference.opensky STATES.csv`` makes detections of real motion, gives them to both
trackers, compares every decision and every estimate of every scan, and draws the tracks. Stone
Soup runs twice: with the exact Jacobian in its initiator, where both sides must agree within
`ROUNDING`, and as it is shipped, with finite differences, where their decisions must agree.
"""

import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import jax
import numpy as np
import tyro

from jaxtrack.cli import parse, run, wide_console
from jaxtrack.geodesy import to_east_north
from jaxtrack.params import Params, StaticParams
from jaxtrack.track import TRACKER_FIELDS
from jaxtrack.trajectories import AIRCRAFT, MAX_AGE, Recording, read_opensky
from jaxtrack.types import Detections
from jaxtrack.validation import validate
from reference.parity.episodes import Comparison, compare_records
from reference.side_by_side import Quality, Run, judge, run_jaxtrack, run_stone_soup
from reference.virtual_radar import observe_aircraft, scan_interval, write_detections

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDING = 1e-7
"""Largest error that passes with the exact Jacobian (standard deviations).

The other parity tests allow 1e-9. Here Stone Soup's own rounding is larger: it inverts S with
radians beside metres, at a condition of 1e10 and more, and a variance that falls by a factor of
hundreds in one update magnifies what is lost. Measured: 3e-9, with missed detections 7e-9; ours
is within 6e-13 of the same updates in 80-bit arithmetic (tests/parity/test_rounding.py).
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """Recorded aircraft through a virtual radar: jaxtrack and Stone Soup side by side.

    Writes detections.csv, tracker.json (for `python -m jaxtrack.track --config`), opensky.json and
    opensky.png. Exit code 1 if the trackers differ.
    """

    path: Annotated[Path, tyro.conf.Positional] = tyro.MISSING
    """OpenSky state vectors (CSV)."""
    scans: int = 0
    """Scans to run; 0 runs all."""
    seed: int = 0
    """Seed of the radar's noise."""
    out: Path = Path("runs/opensky")
    """Folder for the results; made if absent."""
    range_sigma: float = AIRCRAFT["range_sigma"]
    """Standard deviation of measured range (m)."""
    angle_sigma: float = 0.1
    """Standard deviation of measured elevation and bearing (deg)."""
    detection_probability: float = 1.0
    """Probability that an aircraft is detected in a scan."""
    clutter: float = 0.0
    """Expected number of false detections per scan, uniform between the extremes of the true ones."""
    max_age: float = MAX_AGE
    """Reports whose position is older are left out (s)."""
    process_noise: float = AIRCRAFT["process_noise"]
    """White acceleration that the filter assumes (m^2/s^3); 30 follows a turn of 10 m/s^2 between scans."""
    prior_velocity_sigma: float = AIRCRAFT["prior_velocity_sigma"]
    """Standard deviation of a new track's velocity, each axis (m/s); airliners fly up to 260 m/s."""
    deletion_threshold: float = AIRCRAFT["deletion_threshold"]
    """Trace of the covariance above which a track is deleted (m^2 + m^2/s^2)."""
    gate_threshold: float = 5.0
    """Gate, and distance of a missed detection (Mahalanobis distance)."""
    stone_soup: bool = True
    """Run Stone Soup as well; without it only jaxtrack runs."""


def tracker_params(options: Options, time_step: float) -> Params:
    """Numbers of radar and trackers; both sides read these."""
    angle = math.radians(options.angle_sigma)
    params = Params(
        time_step=time_step,
        elevation_sigma=angle,
        bearing_sigma=angle,
        range_sigma=options.range_sigma,
        detection_probability=options.detection_probability,
        process_noise=options.process_noise,
        prior_velocity_sigma=options.prior_velocity_sigma,
        deletion_threshold=options.deletion_threshold,
        gate_threshold=options.gate_threshold,
        missed_distance=options.gate_threshold,
    )
    validate(StaticParams(), params)
    return params


@dataclasses.dataclass(frozen=True)
class Result:
    """One column of the table: a tracker, how good its tracks are, how equal they are to ours."""

    name: str
    run: Run
    quality: Quality
    comparison: Comparison | None = None

    def as_dict(self) -> dict[str, Any]:
        """All figures, for the JSON file."""
        compared = self.comparison
        return {
            "tracker": self.name,
            "seconds": self.run.seconds,
            "compile_seconds": self.run.compile_seconds,
            **dataclasses.asdict(self.quality),
            **(comparison_figures(compared) if compared else {}),
        }


def comparison_figures(compared: Comparison) -> dict[str, Any]:
    """All figures of a comparison, for the JSON file."""
    figures = {**dataclasses.asdict(compared), "decisions": compared.decisions}
    return {**figures, "agreement": compared.agreement, "divergence": str(compared.divergence or "")}


def side_by_side(options: Options, recording: Recording) -> tuple[Detections, list[Result]]:
    """Makes the detections and runs all trackers on them, ours first. Needs double precision."""
    scans = min(options.scans, len(recording.times)) or len(recording.times)
    params = tracker_params(options, scan_interval(recording))
    detections = observe_aircraft(recording, scans, params, options.clutter, options.seed)
    states = recording.states[:scans]
    ours = run_jaxtrack(detections, params)
    results = [Result("jaxtrack", ours, judge(ours.records, detections, states))]
    for exact in (True, False) if options.stone_soup else ():
        theirs = run_stone_soup(detections, params, exact, sys.stderr.isatty())
        compared = compare_records(ours.records, theirs.records, ROUNDING if exact else math.inf)
        name = f"Stone Soup, {'exact' if exact else 'stock'} Jacobian"
        results.append(Result(name, theirs, judge(theirs.records, detections, states), compared))
    return detections, results


def print_table(results: list[Result]) -> None:
    """Prints the figures, one row per tracker, and the first difference of each."""
    from rich.table import Table

    table = Table("tracker", caption="errors in standard deviations of the quantity")
    heads = ("tracks", "updated", "aircraft", "purity", "rmse (m)", "seconds")
    for head in (*heads, "decisions", "agreement", "mean error", "covariance error"):
        table.add_column(head, justify="right")
    for result in results:
        quality, compared = result.quality, result.comparison
        row = [result.name, str(quality.tracks), str(quality.updated_tracks), str(quality.aircraft)]
        row += [f"{quality.purity:.4f}", f"{quality.position_rmse:.1f}", f"{result.run.seconds:.3g}"]
        if compared:
            row += [str(compared.decisions), f"{compared.agreement:.6%}"]
            row += [f"{compared.mean_error:.1e}", f"{compared.covariance_error:.1e}"]
        table.add_row(*row)
    wide_console().print(table)
    for result in results:
        if result.comparison and result.comparison.divergence:
            print(f"first difference from {result.name}: {result.comparison.divergence}")


def draw(recording: Recording, scans: int, ours: Run) -> "Figure":
    """Aircraft and our tracks seen from above, north up, in kilometres from the radar."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.4), dpi=100, layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    truth = to_east_north(recording.states[:scans], recording.radar) / 1000
    for n in range(truth.shape[1]):
        axes.plot(
            *truth[:, n].T, color="0.75", lw=5, solid_capstyle="round", label="_"[n == 0 :] + "aircraft"
        )
    paths: dict[Any, list[np.ndarray]] = {}
    for record in ours.records:
        for key, estimate in record.live.items():
            paths.setdefault(key, []).append(estimate.mean)
    for n, path in enumerate(paths.values()):
        east_north = to_east_north(np.array(path), recording.radar) / 1000
        axes.plot(*east_north.T, color="0.0", lw=0.9, label="_"[n == 0 :] + "track")
        axes.plot(*east_north[0], "k.", ms=3.5, label="_"[n == 0 :] + "birth of a track")
    axes.plot(0, 0, "k^", ms=9, mfc="white", label="radar")
    axes.set(xlabel="east of the radar (km)", ylabel="north of the radar (km)")
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Writes a table of values that a person can read; paths as text."""
    path.write_text(json.dumps(values, indent=1, default=str) + "\n")


def check(options: Options) -> None:
    """Raises ValueError, naming the field, for an option that makes no sense."""
    for name, low in (("scans", 0), ("seed", 0), ("clutter", 0.0)):
        if not getattr(options, name) >= low or not math.isfinite(getattr(options, name)):
            raise ValueError(f"{name} = {getattr(options, name)}: expected a number >= {low}")
    if options.scans == 1:
        raise ValueError("scans = 1: expected 0 for all, or at least 2")


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(Options(), argv, "python -m reference.opensky")
    check(options)
    recording = read_opensky(options.path, max_age=options.max_age)
    radar, (scans, aircraft) = recording.radar, recording.states.shape[:2]
    print(
        f"{options.path}: {scans} scans, {aircraft} aircraft; rows left out: "
        + ", ".join(f"{count} {why}" for why, count in recording.left_out.items())
    )
    print(
        f"radar at {radar.latitude:.4f} deg N, {radar.longitude:.4f} deg E, x axis to {radar.heading:g} deg"
    )
    with jax.enable_x64(True):
        detections, results = side_by_side(options, recording)
    options.out.mkdir(parents=True, exist_ok=True)
    interval = scan_interval(recording)
    write_detections(options.out / "detections.csv", detections, interval)
    numbers = tracker_params(options, interval)
    values = {name: getattr(numbers, name) for name in TRACKER_FIELDS}
    set_values = {name: value for name, value in values.items() if value is not None}
    write_json(options.out / "tracker.json", set_values)
    figures = {"options": vars(options), "radar": vars(radar), "results": [r.as_dict() for r in results]}
    write_json(options.out / "opensky.json", figures)
    draw(recording, len(detections.value), results[0].run).savefig(options.out / "opensky.png")
    print_table(results)
    found = int(detections.active.sum())
    print(f"{options.out}: detections.csv ({found} detections), tracker.json, opensky.json, opensky.png")
    return int(any(result.comparison and result.comparison.divergence for result in results))


if __name__ == "__main__":
    run(main)
