"""Where the filter breaks in float32, and in which form it does not: `python -m benchmarks.float32`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.progress import Progress

from benchmarks.extremes import CASES, DISTANCES, PRIORS, Case, Estimates, follow, simulate
from jaxtrack.cli import LARGEST_SEED, parse, require_file, require_integer, run, wide_console
from jaxtrack.params import FILTERS, StaticParams
from jaxtrack.report import circumstances, print_table, write_report

SAME = 1e-2
"""Float32 is compared where a last bit of the detections changes float64 by no more than this (sigma)."""

LAST_BIT = 1e-15

KINDS = ((True, "full"), (False, "full"), (False, "square_root"))
"""Whether in float64, and covariance form."""


@dataclasses.dataclass(frozen=True)
class Float32Options:
    """Single tracks from 1 m to 1,000 km, with noise down to 1e-6 and prior variances up to 1e12."""

    tracks: int = 40
    """Tracks of each case."""
    updates: int = 100
    """Detections of each track, besides the one that it starts from."""
    seed: int = 0
    """Seed of all that is random."""
    out: Path | None = None
    """JSON file for the results, one row for each filter and case; nothing is written without it."""
    markdown: bool = False
    """Print the tables in Markdown."""


@dataclasses.dataclass(frozen=True)
class Soundness:
    """What is wrong with the estimates of one case.

    Attributes:
        not_finite: `[N]` which tracks have an estimate that is not finite.
        negative: `[N]` which have a variance below zero.
        smallest_variance: of the finite estimates (m^2 or m^2/s^2); NaN without any.
        smallest_eigenvalue: of the finite covariances, in units of their traces (of the sizes of the
            variances, should one be negative); NaN without any.
    """

    not_finite: np.ndarray
    negative: np.ndarray
    smallest_variance: float
    smallest_eigenvalue: float

    def report(self) -> dict[str, Any]:
        """Numbers of tracks, and the smallest ones."""
        return {
            "not_finite": int(self.not_finite.sum()),
            "negative": int(self.negative.sum()),
            "smallest_variance": self.smallest_variance,
            "smallest_eigenvalue": self.smallest_eigenvalue,
        }


def inspect(mean: ArrayLike, covariance: ArrayLike) -> Soundness:
    """Soundness of means `[K, N, 6]` and covariances `[K, N, 6, 6]`."""
    P = np.asarray(covariance, np.float64)
    finite = np.asarray(np.isfinite(P).all(axis=(2, 3)) & np.isfinite(mean).all(axis=2))
    variances = np.where(finite[..., None], np.diagonal(P, axis1=2, axis2=3), np.inf)
    held = P[finite]
    traces = np.abs(np.diagonal(held, axis1=1, axis2=2)).sum(axis=1)
    relative = np.linalg.eigvalsh(held)[:, 0] / np.where(traces == 0, 1, traces)
    return Soundness(
        not_finite=~np.all(finite, axis=0),
        negative=np.any(variances < 0, axis=(0, 2)),
        smallest_variance=float(variances.min()) if len(held) else float("nan"),
        smallest_eigenvalue=float(relative.min()) if len(held) else float("nan"),
    )


def errors(one: Estimates, other: Estimates, case: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest error of each track's means and covariances `[N]`, in sigmas of `other`; may be NaN."""
    P = other.covariance[case]
    with np.errstate(all="ignore"):  # a broken covariance has no sigmas
        sigma = np.sqrt(np.diagonal(P, axis1=2, axis2=3))
        of_mean = np.abs(one.mean[case] - other.mean[case]) / sigma
        of_covariance = np.abs(one.covariance[case] - P) / (sigma[..., :, None] * sigma[..., None, :])
    return of_mean.max(axis=(0, 2)), of_covariance.max(axis=(0, 2, 3))


def measure_filter(name: str, seen: np.ndarray, cases: tuple[Case, ...]) -> list[dict[str, Any]]:
    """One row for each case: what each form and precision makes of it."""
    made = {
        (double, form): follow(seen, cases, StaticParams(filter=name, covariance_form=form), double)
        for double, form in KINDS
    }
    factored = StaticParams(filter=name, covariance_form="square_root")
    truth, shaken = (follow(each, cases, factored, True) for each in (seen, seen * (1 + LAST_BIT)))
    rows = []
    for number, case in enumerate(cases):
        found: dict[str, Any] = {"filter": name, "case": dataclasses.asdict(case)}
        known = np.all(np.array(errors(shaken, truth, number)) <= SAME, axis=0)
        for (double, form), estimates in made.items():
            sound = inspect(estimates.mean[number], estimates.covariance[number])
            entry = sound.report()
            if not double:
                compared = known & ~sound.not_finite
                worst = [each[compared].max(initial=0.0) for each in errors(estimates, truth, number)]
                entry |= {"compared": int(compared.sum()), "mean": worst[0], "covariance": worst[1]}
            found[f"{precision(double)} {form}"] = {
                key: value.item() if isinstance(value, np.generic) else value for key, value in entry.items()
            }
        rows.append(found)
    return rows


def precision(double: bool) -> str:
    """Its name."""
    return "float64" if double else "float32"


def measure_all(options: Float32Options, progress: Progress) -> list[dict[str, Any]]:
    """The rows of all filters."""
    seen = np.stack(
        [
            simulate(case, options.tracks, options.updates, np.random.default_rng([options.seed, number]))
            for number, case in enumerate(CASES)
        ]
    )
    task = progress.add_task("filters", total=len(FILTERS))
    rows = []
    for name in FILTERS:
        rows += measure_filter(name, seen, CASES)
        progress.advance(task)
    return rows


HEADER = (
    "filter", "prior (m/s)", "numbers", "covariances",
    *(f"{distance:,.0f} m" for distance in DISTANCES),
    "smallest variance", "smallest eigenvalue / trace",
)  # fmt: skip
ERROR_HEADER = ("range (m)", "angles (rad)", "range noise (m)", "covariances", *FILTERS)


def breakage_cells(rows: list[dict[str, Any]]) -> list[list[str]]:
    """The lines under `HEADER`: broken tracks of all noises together."""
    lines = []
    for name in FILTERS:
        for prior in PRIORS:
            own = [r for r in rows if r["filter"] == name and r["case"]["prior_velocity_sigma"] == prior]
            for double, form in KINDS:
                key = f"{precision(double)} {form}"
                cells = []
                for distance in DISTANCES:
                    there = [row[key] for row in own if row["case"]["distance"] == distance]
                    cells.append(broken(there))
                for smallest in ("smallest_variance", "smallest_eigenvalue"):
                    cells.append(f"{np.nanmin([row[key][smallest] for row in own]):.1e}")
                lines.append([name, f"{prior:g}", precision(double), form, *cells])
    return lines


def broken(found: list[dict[str, Any]]) -> str:
    """Broken tracks in words, or nothing."""
    counts = {"NaN": "not_finite", "negative": "negative"}
    totals = {word: sum(each[key] for each in found) for word, key in counts.items()}
    return ", ".join(f"{total} {word}" for word, total in totals.items() if total)


def error_cells(rows: list[dict[str, Any]]) -> list[list[str]]:
    """The lines under `ERROR_HEADER`: largest errors with the first prior."""
    lines = []
    for case in CASES:
        if case.prior_velocity_sigma != PRIORS[0]:
            continue
        own = {row["filter"]: row for row in rows if row["case"] == dataclasses.asdict(case)}
        params = case.params()
        for form in ("full", "square_root"):
            cells = [in_words(own[name][f"float32 {form}"]) for name in FILTERS]
            numbers = (case.distance, case.angle_sigma, params.range_sigma)
            lines.append([f"{numbers[0]:,.0f}", *(f"{each:g}" for each in numbers[1:]), form, *cells])
    return lines


def in_words(found: dict[str, Any]) -> str:
    """Errors of mean and covariance, or why there are none."""
    return f"{found['mean']:.0e}; {found['covariance']:.0e}" if found["compared"] else "-"


def check(options: Float32Options) -> None:
    """Raises ValueError, naming the option, before anything is simulated."""
    require_integer("tracks", options.tracks, 1)
    require_integer("updates", options.updates, 1)
    require_integer("seed", options.seed, 0, LARGEST_SEED)
    if options.out is not None:
        require_file("out", options.out)


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(Float32Options(), argv, "python -m benchmarks.float32")
    check(options)
    report, console = circumstances(), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure_all(options, progress)
    per_cell = options.tracks * len(CASES) // len(DISTANCES) // len(PRIORS)
    title = f"broken tracks of {per_cell} at each distance, {options.updates} updates each"
    print_table(HEADER, breakage_cells(rows), title, options.markdown, console)
    title = f"float32, prior {PRIORS[0]:g} m/s: largest errors of mean; covariance against float64 (sigma)"
    print_table(ERROR_HEADER, error_cells(rows), title, options.markdown, console)
    if options.out is not None:
        write_report(options.out, report, options, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
