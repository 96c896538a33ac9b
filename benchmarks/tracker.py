"""The filter and the tracker's step by us, Stone Soup and FilterPy: `python -m benchmarks.tracker`."""

import dataclasses
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress

from benchmarks.operations import OPERATIONS, Ours
from benchmarks.peers import FilterPy, StoneSoup, has_filterpy
from benchmarks.scene import Scene, Timed, error, random_scenes
from jaxtrack.cli import parse, require_file, require_integer, require_positive, run, wide_console
from jaxtrack.env import LARGEST_IN_ONE_KERNEL
from jaxtrack.params import Params
from jaxtrack.report import PACKAGES, circumstances, print_table, spread, with_spread, write_report, written

DIFFERENT = 1
TOLERANCE = {"float64": 1e-9, "float32": 2e-2}
"""Largest difference between two sides that passes, in standard deviations of the quantity compared."""


@dataclasses.dataclass(frozen=True)
class TrackerOptions:
    """Times the filter and one whole step of the tracker, ours beside Stone Soup's and FilterPy's."""

    tracks: tuple[int, ...] = (5, 10, 20, 100)
    """Numbers of live tracks."""
    detections: int = 5
    """Detections in a whole step: one of each of so many tracks less one, and one of something new."""
    batch: int = 64
    """Scenarios that ours does together."""
    single: bool = False
    """Ours in float32, as in the environment, instead of float64, which the other sides use."""
    repeats: int = 5
    """Times that everything is timed, each time on another scenario."""
    min_seconds: float = 0.2
    """Every side works again and again for at least this long in one repeat (s)."""
    seed: int = 0
    """Seed of the scenarios."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


def check(options: TrackerOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    if len(set(options.tracks)) < len(options.tracks) or not options.tracks:
        raise ValueError(f"tracks = {options.tracks}: expected different numbers")
    require_integer("detections", options.detections, 1)
    for number in (min(options.tracks), max(options.tracks)):
        require_integer("tracks", number, options.detections, LARGEST_IN_ONE_KERNEL["max_tracks"])
    require_integer("batch", options.batch, 2)
    require_integer("repeats", options.repeats, 1)
    require_integer("seed", options.seed, 0)
    require_positive("min_seconds", options.min_seconds)
    if options.out is not None:
        require_file("out", options.out)


def time_peer(operation: Callable[[Scene], Timed], scene: Scene, min_seconds: float) -> Timed:
    """Mean seconds of one pass, each on new objects, and what came out."""
    seconds, passes = 0.0, 0
    while seconds < min_seconds or not passes:
        taken, found = operation(scene)
        seconds, passes = seconds + taken, passes + 1
    return seconds / passes, found


def measure(options: TrackerOptions, params: Params, progress: Progress) -> list[dict[str, Any]]:
    """Times all sides in turns, so that whatever else the machine does hits all.

    Returns:
        One row for each operation and number of tracks.
    """
    peers: dict[str, Any] = {"stone_soup": StoneSoup(params)}
    if has_filterpy():
        peers["filterpy"] = FilterPy(params)
    cases = list(product(OPERATIONS, options.tracks))
    task = progress.add_task("compiling", total=len(cases) * (1 + options.repeats))
    number = max(options.batch, options.repeats)
    scenes = {
        count: random_scenes(number, count, options.detections, options.seed, params)
        for count in options.tracks
    }
    with jax.enable_x64(not options.single):
        ours = {}
        for operation, count in cases:
            ours[operation, count] = Ours(operation, scenes[count], options.batch, params)
            progress.advance(task)
        progress.update(task, description="measuring")
        found: dict[tuple[str, int], list[OneRepeat]] = {case: [] for case in cases}
        for repeat, case in product(range(options.repeats), cases):
            scene = jax.tree.map(lambda leaf, repeat=repeat: leaf[repeat], scenes[case[1]])
            able = {side: getattr(peer, case[0]) for side, peer in peers.items() if hasattr(peer, case[0])}
            found[case].append(measure_once(ours[case], repeat, able, scene, options.min_seconds))
            progress.advance(task)
    return [make_row(case, found[case], ours[case].compile_seconds) for case in cases]


OneRepeat = tuple[dict[str, float], dict[str, float]]
"""Seconds of every side, and how far our result is from each of the others' (standard deviations)."""


def measure_once(
    ours: Ours, place: int, peers: dict[str, Callable[[Scene], Timed]], scene: Scene, min_seconds: float
) -> OneRepeat:
    """One operation by all sides that have it, on the scenario at one place."""
    seconds, errors = {}, {}
    for side, operation in peers.items():
        seconds[side], theirs = time_peer(operation, scene, min_seconds)
        errors[side] = error(ours.result(place), theirs)
    seconds["alone"], seconds["batch"] = ours.time(place, min_seconds)
    return seconds, errors


def make_row(case: tuple[str, int], repeats: list[OneRepeat], compile_seconds: float) -> dict[str, Any]:
    """What one operation and number of tracks gave; ratios are those of the medians."""
    sides = repeats[0][0]
    micros = {side: spread([1e6 * seconds[side] for seconds, _ in repeats]) for side in sides}
    errors = {side: float(np.max([found[side] for _, found in repeats])) for side in repeats[0][1]}
    return {
        "operation": case[0],
        "tracks": case[1],
        "microseconds": micros,
        "largest_difference_sigma": errors,
        "ratios": {
            f"{peer} / {own}": micros[peer]["median"] / micros[own]["median"]
            for peer in errors
            for own in ("alone", "batch")
        },
        "compile_seconds": compile_seconds,
    }


HEADER = (
    "", "tracks", "alone, µs", "in a batch, µs", "Stone Soup, µs", "ratio", "FilterPy, µs",
    "ratio", "largest difference", "compiled in",
)  # fmt: skip


def header(rows: list[dict[str, Any]]) -> list[str]:
    """`HEADER`, without FilterPy's columns where it is not installed."""
    return list(HEADER) if shows_filterpy(rows) else [*HEADER[:6], *HEADER[8:]]


def shows_filterpy(rows: list[dict[str, Any]]) -> bool:
    """Whether any row has a time of FilterPy's."""
    return any("filterpy" in row["microseconds"] for row in rows)


def cells(row: dict[str, Any], with_filterpy: bool) -> list[str]:
    """The row under `header`; ratios are to ours alone / in a batch."""

    def speed(side: str) -> str:
        return with_spread(row["microseconds"][side]) if side in row["microseconds"] else ""

    def ratio(side: str) -> str:
        both = [row["ratios"].get(f"{side} / {own}") for own in ("alone", "batch")]
        return " / ".join(written(value) for value in both if value is not None)

    line = [row["operation"], str(row["tracks"]), speed("alone"), speed("batch")]
    for side in ("stone_soup", "filterpy")[: 1 + with_filterpy]:
        line += [speed(side), ratio(side)]
    return [*line, f"{max(row['largest_difference_sigma'].values()):.1e}", f"{row['compile_seconds']:.1f} s"]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(TrackerOptions(), argv, "python -m benchmarks.tracker")
    check(options)
    params, report, console = Params(), circumstances((*PACKAGES, "filterpy")), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, params, progress)
    kind = "float32" if options.single else "float64"
    largest = float(np.max([error for row in rows for error in row["largest_difference_sigma"].values()]))
    same, machine, with_filterpy = largest <= TOLERANCE[kind], report["machine"], shows_filterpy(rows)
    title = (
        f"median of {options.repeats} repeats (smallest - largest); the results are "
        f"{'the same' if same else 'DIFFERENT'} (largest difference {largest:.1e}, "
        f"allowed {TOLERANCE[kind]:.0e} standard deviations); "
        f"jaxtrack in {kind}, batches of {options.batch}; "
        f"{options.detections} detections in a whole step; "
        f"{'' if with_filterpy else 'FilterPy is not installed (extra bench); '}"
        f"{machine['processor']}, {machine['cores']} cores, {machine['jax_backend']}"
    )
    print_table(header(rows), [cells(row, with_filterpy) for row in rows], title, options.markdown, console)
    if options.out is not None:
        found = {"largest_difference_sigma": largest, "rows": rows}
        write_report(options.out, report, options, scenario=vars(params), **found)
    return 0 if same else DIFFERENT


if __name__ == "__main__":
    run(main)
