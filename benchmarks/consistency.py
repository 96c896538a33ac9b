"""Whether the filter errs as much as its covariances say: `python -m benchmarks.consistency`."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from rich.progress import Progress
from scipy.stats import chi2

from jaxtrack import kalman, lifecycle
from jaxtrack.cli import LARGEST_SEED, parse, require_file, require_integer, run, wide_console
from jaxtrack.models import (
    direction,
    elevation_bearing_range,
    interleave,
    measurement_sigmas,
    spherical,
    wrap_detection,
)
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, write_report
from jaxtrack.truth import move_truths
from jaxtrack.types import DETECTION_DIM, STATE_DIM, Detections, Tracks, Truths
from train.episode_metrics import nees

CHUNK = 1000
"""Runs in one call, between which the progress bar moves."""

CONFIDENCE = 0.99
"""Of all steps of a case together: so often a consistent filter's means all lie inside their bands."""

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


@dataclasses.dataclass(frozen=True)
class Case:
    """Where the targets are, how often and how well they are seen.

    Attributes:
        distance: from the radar at the start (m).
        azimuth: at the start (degrees).
        elevation: at the start (degrees).
        time_step: between detections (s).
        angle_sigma: of measured elevation and bearing (rad).
    """

    distance: float
    azimuth: float = 0.0
    elevation: float = 0.0
    time_step: float = 0.5
    angle_sigma: float = 2e-3

    def params(self) -> Params:
        """The paper's numbers but for these, with truths that move as the filter assumes."""
        base = Params()
        return base.replace(
            time_step=self.time_step,
            elevation_sigma=self.angle_sigma,
            bearing_sigma=self.angle_sigma,
            truth_process_noise=base.process_noise,
            truth_velocity_sigma=base.prior_velocity_sigma,
        )


CASES = {
    "1 km, ahead": Case(1_000.0, time_step=0.1),
    "5 km, aside and above": Case(5_000.0, azimuth=-45.0, elevation=30.0),
    "10 km, ahead": Case(10_000.0, time_step=1.0),
    "10 km, corner of the field": Case(10_000.0, azimuth=60.0, elevation=60.0, time_step=1.0),
    "10 km, behind": Case(10_000.0, azimuth=180.0, time_step=1.0),
    "10 km, 10 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.01),
    "10 km, 20 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.02),
    "10 km, 50 mrad": Case(10_000.0, time_step=1.0, angle_sigma=0.05),
}


class Errors(struct.PyTreeNode):
    """Normalised errors squared of runs `[R]` after each step `[K]`.

    Attributes:
        nees: `[K, R]` of the estimate after the update, ``e' P^-1 e``.
        nis: `[K, R]` of the detection before it, ``v' S^-1 v``.
    """

    nees: jax.Array
    nis: jax.Array


def simulate(
    key: jax.Array, place: jax.Array, world: Params, params: Params, start: str, runs: int, steps: int
) -> Errors:
    """Follows each of `runs` truths with a track of its own, by the tracker's functions.

    Args:
        key: random key.
        place: `[3]` elevation, bearing (rad) and range (m) of all truths at the start.
        world: numbers of what happens: process noise of the truths, noise of the detections.
        params: numbers of the filter; those of the world, if the models match.
        start: "prior" draws each truth from the Gaussian that its track begins with; "detection"
            begins each track with a detection of its truth.
        runs: number of truths, R.
        steps: number of detections, K.
    """
    key_start, key_steps = jax.random.split(key)
    begin = {"prior": from_prior, "detection": from_detection}[start]
    state, mean, covariance = begin(key_start, place, world, params, runs)
    own = jnp.arange(runs)
    alive = jnp.ones(runs, dtype=bool)
    tracks = Tracks.empty(runs).replace(mean=mean, covariance=covariance, active=alive)

    def step(carry: tuple[Truths, Tracks], key: jax.Array) -> tuple[tuple[Truths, Tracks], Errors]:
        truths, tracks = carry
        key_motion, key_noise = jax.random.split(key)
        truths = move_truths(truths, jax.random.normal(key_motion, (runs, 3, 2)), world)
        value = measure(key_noise, elevation_bearing_range(truths.state), world)
        predicted = kalman.predict(tracks, params.time_step, params)
        expected = kalman.predict_detections(predicted, params)
        tracks = kalman.update(predicted, expected, Detections.from_values(value), own)
        errors = Errors(
            nees=nees(truths.state - tracks.mean, tracks.covariance),
            nis=quadratic(wrap_detection(value - expected.mean), expected.covariance),
        )
        return (truths, tracks), errors

    truths = Truths(state=state, alive=alive)
    return jax.lax.scan(step, (truths, tracks), jax.random.split(key_steps, steps))[1]


Beginning = tuple[jax.Array, jax.Array, jax.Array]
"""True states `[R, 6]`, and means `[R, 6]` and covariances `[R, 6, 6]` of their tracks."""


def from_prior(key: jax.Array, place: jax.Array, world: Params, params: Params, runs: int) -> Beginning:
    """All tracks begin alike, and the truths are drawn from their Gaussian: an exact match."""
    del world
    mean, covariance = lifecycle.initial_estimate(jnp.broadcast_to(place, (runs, DETECTION_DIM)), params)
    noise = jax.random.normal(key, (runs, STATE_DIM))
    return mean + (jnp.linalg.cholesky(covariance) @ noise[..., None])[..., 0], mean, covariance


def from_detection(key: jax.Array, place: jax.Array, world: Params, params: Params, runs: int) -> Beginning:
    """All truths begin in one place, each track with a detection, as the tracker initiates it."""
    key_velocity, key_noise = jax.random.split(key)
    elevation, bearing, distance = place
    point = distance * jnp.broadcast_to(direction(bearing, elevation), (runs, 3))
    velocity = world.truth_velocity_sigma * jax.random.normal(key_velocity, (runs, 3))
    detection = measure(key_noise, spherical(point), world)
    return interleave(point, velocity), *lifecycle.initial_estimate(detection, params)


def measure(key: jax.Array, places: jax.Array, world: Params) -> jax.Array:
    """Detections `[R, 3]` of truths at elevations, bearings and ranges `[R, 3]`."""
    return wrap_detection(places + measurement_sigmas(world) * jax.random.normal(key, places.shape))


def quadratic(difference: jax.Array, covariance: jax.Array) -> jax.Array:
    """``v' S^-1 v`` `[R]` of `[R, 3]` and `[R, 3, 3]`."""
    solved = jnp.linalg.solve(covariance, difference[..., None])[..., 0]
    return jnp.sum(difference * solved, axis=-1)


def band(dimension: int, runs: int, confidence: float) -> tuple[float, float]:
    """Two-sided band of a consistent filter's mean of `runs` normalised errors squared."""
    tail = (1 - confidence) / 2
    low, high = chi2.ppf((tail, 1 - tail), dimension * runs) / runs
    return float(low), float(high)


def judge(values: np.ndarray, dimension: int) -> dict[str, Any]:
    """Compares the means over runs of values `[K, R]` with their bands, step by step.

    Returns:
        The mean over all in units of a consistent filter's, with the half width of its 95 % interval
        by the spread of the runs; how many steps lie in their own 95 % band; whether all lie inside the
        wider one that holds for all of them together; the step that lies farthest out; all means.
    """
    steps, runs = values.shape
    means = values.mean(axis=1)
    low, high = band(dimension, runs, 0.95)
    widest = band(dimension, runs, CONFIDENCE ** (1 / steps))
    of_runs = values.mean(axis=0) / dimension
    farthest = int(np.argmax(np.abs(means - dimension)))
    return {
        "ratio": float(of_runs.mean()),
        "half_width": 1.96 * float(of_runs.std(ddof=1)) / math.sqrt(runs),
        "share_in_95": float(np.mean((low <= means) & (means <= high))),
        "inside": bool(np.all((widest[0] <= means) & (means <= widest[1]))),
        "farthest_step": farthest + 1,
        "farthest": float(means[farthest]),
        "band": widest,
        "means": means.tolist(),
    }


def simulate_case(
    name: str, start: str, options: ConsistencyOptions, double: bool, world: Params | None = None
) -> Errors:
    """All runs of one of `CASES` on the host, in pieces; the models match unless `world` is another."""
    case, number = CASES[name], list(CASES).index(name)
    params, own_key = case.params(), jax.random.fold_in(jax.random.key(options.seed), number)
    with jax.enable_x64(double):
        angles = [math.radians(case.elevation), math.radians(case.azimuth), case.distance]
        place = wrap_detection(jnp.array(angles, dtype=float))
        compiled = jax.jit(simulate, static_argnames=("start", "runs", "steps"))
        pieces = []
        for first in range(0, options.runs, CHUNK):
            key = jax.random.fold_in(own_key, first)
            runs = min(CHUNK, options.runs - first)
            found = compiled(key, place, world or params, params, start=start, runs=runs, steps=options.steps)
            pieces.append(jax.device_get(found))
    return jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *pieces)


def measure_all(options: ConsistencyOptions, progress: Progress) -> list[dict[str, Any]]:
    """One row for each precision, start and case."""
    task = progress.add_task("simulating", total=2 * len(STARTS) * len(CASES))
    rows = []
    for double in (True, False):
        for start in STARTS:
            for name in CASES:
                errors = simulate_case(name, start, options, double)
                rows.append(
                    {
                        "case": name,
                        "start": start,
                        "precision": "float64" if double else "float32",
                        "nees": judge(np.asarray(errors.nees), STATE_DIM),
                        "nis": judge(np.asarray(errors.nis), DETECTION_DIM),
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
        f"all steps of a case within the band that holds for all of them in {100 * CONFIDENCE:.0f} %"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        cases = {name: vars(case) for name, case in CASES.items()}
        scenario = {**vars(StaticParams()), **vars(Params())}
        write_report(options.out, report, options, scenario=scenario, cases=cases, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
