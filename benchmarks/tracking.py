"""Speed of the tracker on a recorded file, beside Stone Soup's: `python -m benchmarks.tracking`."""

import dataclasses
import datetime
import resource
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrack.cli import parse, require_file, require_integer, run, wide_console
from jaxtrack.detection_file import COLUMNS, RecordedDetections, read_detections
from jaxtrack.params import Params
from jaxtrack.report import circumstances, print_table, write_report
from jaxtrack.track import Options, track_file
from jaxtrack.tracking import TrackRows, track_scans
from reference.components import EPOCH, noise_sigmas
from reference.parity.compare import TOLERANCE, covariance_error, mean_error
from reference.parity.scenes import spherical
from reference.pipeline import StepRecord, StoneSoupTracker
from reference.translate import TrackKey

DIFFERENT = 1
PARAMS = Params(process_noise=10.0)
INTERVAL, DETECTED, CLUTTER = 0.1, 0.95, 1.0
"""Time between scans (s), probability of detection, false detections per scan."""


@dataclasses.dataclass(frozen=True)
class TrackingOptions:
    """Tracks a synthetic file with the command's own code, and its first scans with Stone Soup."""

    detections: int = 1_000_000
    """Detections in the file."""
    targets: int = 50
    """Targets, each detected in 95 of 100 scans; one false detection per scan on average."""
    stone_soup_seconds: float = 30.0
    """Stone Soup tracks the first scans for at least this long (s)."""
    seed: int = 0
    """Seed of the file."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


def check(options: TrackingOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    for name, low in (("detections", 1), ("targets", 1), ("seed", 0)):
        require_integer(name, getattr(options, name), low)
    if not 0 < options.stone_soup_seconds < np.inf:
        raise ValueError(f"stone_soup_seconds = {options.stone_soup_seconds}: expected a number > 0")
    if options.out is not None:
        require_file("out", options.out)


def synthetic_scans(targets: int, seed: int) -> Iterator[np.ndarray]:
    """Detections `[D, 3]` of one scan after the other: targets on circles, noise, misses, clutter."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((targets, 3))
    centre = (
        direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(3e3, 1e4, (targets, 1))
    )
    radius, speed = rng.uniform(300, 1500, targets), rng.uniform(10, 50, targets)
    sigmas = noise_sigmas(PARAMS)
    scan = 0
    while True:
        angle = speed / radius * INTERVAL * scan
        circle = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(targets)])
        seen = spherical(centre + circle.T) + sigmas * rng.standard_normal((targets, 3))
        seen = seen[rng.random(targets) < DETECTED]
        count = rng.poisson(CLUTTER)
        elevation = np.arcsin(rng.uniform(-1, 1, count))
        clutter = [elevation, rng.uniform(-np.pi, np.pi, count), rng.uniform(1e3, 1.1e4, count)]
        value = np.concatenate([seen, np.stack(clutter, axis=1)])
        value[:, :2] = np.clip(value[:, :2], [-np.pi / 2, -np.pi], [np.pi / 2, np.pi])
        yield value
        scan += 1


def write_file(path: Path, options: TrackingOptions) -> None:
    """Writes scans until there are as many detections as asked for."""
    left = options.detections
    with open(path, "w") as file:
        file.write(",".join(COLUMNS) + "\n")
        for scan, value in enumerate(synthetic_scans(options.targets, options.seed)):
            rows = value[:left].tolist()
            file.writelines(f"{scan * INTERVAL:.1f},{e!r},{b!r},{r!r}\n" for e, b, r in rows)
            left -= len(rows)
            if not left:
                return


def time_ours(folder: Path, options: TrackingOptions) -> tuple[RecordedDetections, dict[str, Any]]:
    """Reads, tracks and writes as the command does."""
    source, out = folder / "detections.csv", folder / "tracks.csv"
    write_file(source, options)
    began = time.perf_counter()
    recorded = read_detections(source)
    read_seconds = time.perf_counter() - began
    summary = track_file(recorded, PARAMS, Options(detections=source, out=out))
    seconds = read_seconds + summary.seconds
    kilobytes = 1024 if sys.platform == "darwin" else 1
    return recorded, {
        "detections": summary.detections,
        "scans": summary.scans,
        "tracks": summary.tracks,
        "read_seconds": read_seconds,
        "track_and_write_seconds": summary.seconds,
        "compile_seconds": summary.compile_seconds,
        "detections_per_second": summary.detections / seconds,
        "scans_per_second": summary.scans / seconds,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000 / kilobytes,
        "output_mb": out.stat().st_size / 1e6,
    }


def time_stone_soup(recorded: RecordedDetections, least_seconds: float) -> tuple[list[StepRecord], float]:
    """What the stock tracker did in the first scans, and how long it took (s)."""
    oracle, records, seconds = StoneSoupTracker(PARAMS, intermediates=False), list[StepRecord](), 0.0
    for microseconds, start, count in zip(recorded.time, recorded.start, recorded.count, strict=True):
        if seconds >= least_seconds:
            break
        moment = EPOCH + datetime.timedelta(microseconds=int(microseconds))
        began = time.perf_counter()
        records.append(oracle.step(recorded.value[start : start + count], time=moment))
        seconds += time.perf_counter() - began
    return records, seconds


def largest_difference(chunks: Iterator[TrackRows], records: list[StepRecord]) -> float:
    """Largest error of our rows for the scans on record (standard deviations).

    Infinite where the live tracks or their detections differ.
    """
    numbers: dict[TrackKey, int] = {}
    largest, done = 0.0, 0
    for rows in chunks:
        for scan in range(done, min(rows.scans.stop, len(records))):
            theirs = records[scan]
            numbers |= {key: len(numbers) + place for place, key in enumerate(sorted(theirs.initiated))}
            expected = sorted((numbers[key], theirs.source(key), key) for key in theirs.live)
            mine = np.flatnonzero(rows.scan == scan)
            pairs = zip(rows.track[mine].tolist(), rows.detection[mine].tolist(), strict=True)
            if list(pairs) != [(number, source) for number, source, _ in expected]:
                return float("inf")
            for row, (_, _, key) in zip(mine, expected, strict=True):
                live = theirs.live[key]
                error = mean_error(rows.mean[row], live.mean, live.covariance)
                largest = max(largest, error, covariance_error(rows.covariance[row], live.covariance))
        done = rows.scans.stop
        if done >= len(records):
            break
    return largest


def measure(options: TrackingOptions) -> dict[str, Any]:
    """Both sides on the same file, and how far apart they are."""
    with jax.enable_x64(True), tempfile.TemporaryDirectory() as folder:
        recorded, ours = time_ours(Path(folder), options)
        records, seconds = time_stone_soup(recorded, options.stone_soup_seconds)
        difference = largest_difference(track_scans(recorded, PARAMS), records)
    detections = int(recorded.count[: len(records)].sum())
    return {
        "jaxtrack": ours,
        "stone_soup": {
            "scans": len(records),
            "seconds": seconds,
            "scans_per_second": len(records) / seconds,
            "detections_per_second": detections / seconds,
        },
        "ratio": ours["scans_per_second"] * seconds / len(records),
        "largest_difference_sigma": difference,
    }


HEADER = ("", "scans", "detections/s", "scans/s", "reading", "tracking, writing", "compiling", "memory")


def cells(row: dict[str, Any]) -> list[list[str]]:
    """Both sides under `HEADER`."""
    ours, theirs = row["jaxtrack"], row["stone_soup"]
    speeds = [
        [f"{side['scans']:,}", f"{side['detections_per_second']:,.0f}", f"{side['scans_per_second']:,.1f}"]
        for side in (ours, theirs)
    ]
    times = [f"{ours[f'{name}_seconds']:.1f} s" for name in ("read", "track_and_write", "compile")]
    return [
        ["jaxtrack", *speeds[0], *times, f"{ours['peak_memory_mb']:,.0f} MB"],
        ["Stone Soup", *speeds[1], "", f"{theirs['seconds']:.1f} s", "", ""],
    ]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(TrackingOptions(), argv, "python -m benchmarks.tracking")
    check(options)
    report = circumstances()
    row = measure(options)
    same = row["largest_difference_sigma"] <= TOLERANCE
    title = (
        f"{row['jaxtrack']['detections']:,} detections of {options.targets} targets, "
        f"{row['jaxtrack']['tracks']:,} tracks; ratio {row['ratio']:,.0f}; the tracks of the first "
        f"{row['stone_soup']['scans']} scans are {'the same' if same else 'DIFFERENT'} "
        f"(largest difference {row['largest_difference_sigma']:.1e} sigma); "
        f"{report['machine']['processor']}, {report['machine']['cores']} cores"
    )
    print_table(HEADER, cells(row), title, options.markdown, wide_console())
    if options.out is not None:
        write_report(options.out, report, options, scenario=vars(PARAMS), **row)
    return 0 if same else DIFFERENT


if __name__ == "__main__":
    run(main)
