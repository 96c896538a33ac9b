"""Whether the filter errs as much as its covariances say: `python -m benchmarks.consistency`."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.progress import Progress
from scipy.stats import chi2, norm

from benchmarks.matched import CASES, simulate_case
from jaxtrack.cli import LARGEST_SEED, parse, require_file, require_integer, run, wide_console
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, write_report
from jaxtrack.types import DETECTION_DIM, STATE_DIM

CONFIDENCE = 0.99
"""So often all comparisons of the whole table find a consistent filter consistent."""

STARTS = ("prior", "detection")


@dataclasses.dataclass(frozen=True)
class ConsistencyOptions:
    """Single tracks with the models that the filter assumes: mean NEES and NIS against their bands."""

    runs: int = 10_000
    """Tracks of each case."""
    steps: int = 40
    """Detections of each track, besides the one that it starts from."""
    seed: int = 0
    """Seed of all that is random."""
    out: Path | None = None
    """JSON file for the results, every step's means included; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


def band(dimension: int, runs: int, confidence: float) -> tuple[float, float]:
    """Two-sided band of a consistent filter's mean of `runs` normalised errors squared."""
    tail = (1 - confidence) / 2
    low, high = chi2.ppf((tail, 1 - tail), dimension * runs) / runs
    return float(low), float(high)


def judge(values: np.ndarray, dimension: int, comparisons: int = 1) -> dict[str, Any]:
    """Compares the means over runs of values `[K, R]` with their bands, step by step, and that over all.

    Args:
        values: normalised errors squared.
        dimension: of the errors, the mean of a consistent filter's values.
        comparisons: how often values are judged in the same table, which widens the bands.

    Returns:
        The mean over all in units of a consistent filter's, with the half width of its 95 % interval
        by the spread of the runs; the share of steps in their own 95 % band; whether all lie inside the
        band that holds for all steps of the table, and the mean in its interval; the step that lies
        farthest out; all means.
    """
    steps, runs = values.shape
    means = values.mean(axis=1)
    low, high = band(dimension, runs, 0.95)
    widest = band(dimension, runs, CONFIDENCE ** (1 / (comparisons * steps)))
    of_runs = values.mean(axis=0) / dimension
    ratio, error = float(of_runs.mean()), float(of_runs.std(ddof=1)) / math.sqrt(runs)
    allowed = float(norm.ppf((1 + CONFIDENCE ** (1 / comparisons)) / 2)) * error
    farthest = int(np.argmax(np.abs(means - dimension)))
    return {
        "ratio": ratio,
        "half_width": 1.96 * error,
        "share_in_95": float(np.mean((low <= means) & (means <= high))),
        "inside": bool(np.all((widest[0] <= means) & (means <= widest[1]))) and abs(ratio - 1) <= allowed,
        "farthest_step": farthest + 1,
        "farthest": float(means[farthest]),
        "band": widest,
        "means": means.tolist(),
    }


def measure_all(options: ConsistencyOptions, progress: Progress) -> list[dict[str, Any]]:
    """One row for each precision, start and case."""
    total = 2 * len(STARTS) * len(CASES)
    task = progress.add_task("simulating", total=total)
    rows = []
    for double in (True, False):
        for start in STARTS:
            for number, (name, case) in enumerate(CASES.items()):
                with jax.enable_x64(double):
                    key = jax.random.fold_in(jax.random.key(options.seed), number)
                    errors = simulate_case(case, start, options.runs, options.steps, key)
                rows.append(
                    {
                        "case": name,
                        "start": start,
                        "precision": "float64" if double else "float32",
                        "nees": judge(np.asarray(errors.nees), STATE_DIM, 2 * total),
                        "nis": judge(np.asarray(errors.nis), DETECTION_DIM, 2 * total),
                    }
                )
                progress.advance(task)
    return rows


HEADER = (
    "case", "start", "precision",
    "NEES / 6", "steps in 95 %", "verdict", "NIS / 3", "steps in 95 %", "verdict",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`."""
    return [row["case"], row["start"], row["precision"], *in_words(row["nees"]), *in_words(row["nis"])]


def in_words(found: dict[str, Any]) -> list[str]:
    """Mean, share of the steps, and verdict."""
    steps = len(found["means"])
    return [
        f"{found['ratio']:.4f} ± {found['half_width']:.4f}",
        f"{round(found['share_in_95'] * steps)} of {steps}",
        "inside" if found["inside"] else f"BIASED by {100 * (found['ratio'] - 1):+.1f} %",
    ]


def check(options: ConsistencyOptions) -> None:
    """Raises ValueError, naming the option, before anything is simulated."""
    require_integer("runs", options.runs, 2)
    require_integer("steps", options.steps, 1)
    require_integer("seed", options.seed, 0, LARGEST_SEED)
    if options.out is not None:
        require_file("out", options.out)


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(ConsistencyOptions(), argv, "python -m benchmarks.consistency")
    check(options)
    report, console = circumstances(), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure_all(options, progress)
    ends = [band(dimension, options.runs, 0.95) for dimension in (STATE_DIM, DETECTION_DIM)]
    title = (
        f"means of {options.runs:,} runs of {options.steps} steps, with 95 % intervals; "
        f"95 % band of one step's mean: NEES [{ends[0][0]:.3f}, {ends[0][1]:.3f}], "
        f"NIS [{ends[1][0]:.3f}, {ends[1][1]:.3f}]; inside: "
        f"within the bands that hold for all steps and means of the table in {100 * CONFIDENCE:.0f} %"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        cases = {name: vars(case) for name, case in CASES.items()}
        scenario = {**vars(StaticParams()), **vars(Params())}
        write_report(options.out, report, options, scenario=scenario, cases=cases, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
