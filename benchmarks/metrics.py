"""GOSPA and SIAP of whole episodes, ours and Stone Soup's: `python -m benchmarks.metrics`."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.progress import Progress
from stonesoup.dataassociator.tracktotrack import TrackToTruth
from stonesoup.metricgenerator.base import MetricGenerator
from stonesoup.metricgenerator.manager import MultiManager

from benchmarks.operations import mean_seconds
from jaxtrack import policies
from jaxtrack.cli import parse, require_file, require_integer, require_positive, run, wide_console
from jaxtrack.env import make
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, with_spread, write_report, written
from jaxtrack.types import Tracks, Truths
from reference.components import step_duration
from reference.parity.metrics import Ours, largest_error, our_gospa, our_siap
from reference.parity.records import Record
from reference.parity.stock_metrics import Numbers, StockRecord, stock_gospa, stock_siap

DIFFERENT = 1
TOLERANCE = 1e-6
"""Largest |a - b| / max(1, |b|) that passes, units as they are."""


@dataclasses.dataclass(frozen=True)
class MetricsOptions:
    """Times GOSPA and SIAP of the same tracks and truths on both sides, and compares every value."""

    steps: int = 1000
    """Steps of an episode."""
    batch: int = 16
    """Episodes that ours does together."""
    repeats: int = 5
    """Episodes on which everything is timed once."""
    min_seconds: float = 0.5
    """Ours works again and again for at least this long in one repeat (s)."""
    seed: int = 0
    """Seed of the episodes."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


def check(options: MetricsOptions, params: Params) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    require_integer("steps", options.steps, 3, params.max_steps_in_episode)
    require_integer("batch", options.batch, 2)
    require_integer("repeats", options.repeats, 1)
    require_integer("seed", options.seed, 0)
    require_positive("min_seconds", options.min_seconds)
    if options.out is not None:
        require_file("out", options.out)


class TimedRecord(StockRecord):
    """A record that adds up how long Stone Soup's generators and its associator work.

    Attributes:
        seconds: in `MultiManager` alone, without making its objects of our arrays (s).
    """

    seconds = 0.0

    def managed(self, generator: MetricGenerator, associator: TrackToTruth | None = None) -> MultiManager:
        """As `StockRecord.managed`, with a clock."""
        began = time.perf_counter()
        manager = super().managed(generator, associator)
        self.seconds += time.perf_counter() - began
        return manager


@dataclasses.dataclass(frozen=True)
class Metric:
    """One metric on both sides: numbers by name, of which Stone Soup's are compared."""

    ours: Callable[[Truths, Tracks, jax.Array, Params], Ours]
    theirs: Callable[[StockRecord], Numbers]


METRICS = {"GOSPA": Metric(our_gospa, stock_gospa), "SIAP": Metric(our_siap, stock_siap)}


def episodes(static: StaticParams, params: Params, options: MetricsOptions) -> tuple[Truths, Tracks]:
    """Truths and tracks `[max(batch, repeats), steps]` of episodes played by the index rule."""
    env, params = make(params, static)
    policy = policies.index(static, params)

    def play(key: jax.Array) -> tuple[Truths, Tracks]:
        key_reset, key_steps = jax.random.split(key)

        def step(state: Any, key: jax.Array) -> tuple[Any, tuple[Truths, Tracks]]:
            state, _ = env.play(key, state, policy(key, state), params)
            return state, (state.truths, state.tracks)

        _, state = env.reset_env(key_reset, params)
        return jax.lax.scan(step, state, jax.random.split(key_steps, options.steps))[1]

    keys = jax.random.split(jax.random.key(options.seed), max(options.batch, options.repeats))
    return jax.device_get(jax.jit(jax.vmap(play))(keys))


class Compiled:
    """One metric compiled for one episode and for a batch of them, in float64.

    Attributes:
        compile_seconds: what compiling both took (s).
    """

    def __init__(self, metric: Metric, record: tuple[Truths, Tracks], batch: int, params: Params) -> None:
        steps = record[0].alive.shape[1]
        times = jnp.arange(steps) * step_duration(params).total_seconds()
        self.rest, self.record, self.batch = (times, params), record, batch
        self.few = jax.tree.map(lambda leaf: jnp.asarray(leaf[:batch]), record)
        began = time.perf_counter()
        self.one = jax.jit(metric.ours).lower(*self.episode(0), *self.rest).compile()
        together = jax.vmap(metric.ours, in_axes=(0, 0, None, None))
        self.all = jax.jit(together).lower(*self.few, *self.rest).compile()
        self.compile_seconds = time.perf_counter() - began
        jax.block_until_ready((self.result(0), self.all(*self.few, *self.rest)))

    def episode(self, place: int) -> tuple[Truths, Tracks]:
        """One of the episodes."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[place]), self.record)

    def result(self, place: int) -> Numbers:
        """Values of one episode."""
        return jax.device_get(self.one(*self.episode(place), *self.rest))

    def time(self, place: int, min_seconds: float) -> tuple[float, float]:
        """Seconds for one episode by itself, and for one of a batch."""
        one = jax.block_until_ready(self.episode(place))
        alone = mean_seconds(lambda: self.one(*one, *self.rest), min_seconds)
        return alone, mean_seconds(lambda: self.all(*self.few, *self.rest), min_seconds) / self.batch


def measure(
    options: MetricsOptions, static: StaticParams, params: Params, progress: Progress
) -> list[dict[str, Any]]:
    """Times both sides in turns, so that whatever else the machine does hits both.

    Returns:
        One row for each metric.
    """
    task = progress.add_task("compiling", total=len(METRICS) * (1 + options.repeats))
    played = episodes(static, params, options)
    record = jax.tree.map(lambda leaf: leaf.astype(float) if leaf.dtype.kind == "f" else leaf, played)
    with jax.enable_x64(True):
        ours = {}
        for name, metric in METRICS.items():
            ours[name] = Compiled(metric, record, options.batch, params)
            progress.advance(task)
        progress.update(task, description="measuring")
        found: dict[str, list[dict[str, float]]] = {name: [] for name in METRICS}
        for repeat in range(options.repeats):
            truths, tracks = jax.tree.map(lambda leaf, repeat=repeat: leaf[repeat], record)
            for name, metric in METRICS.items():
                stock = TimedRecord(Record(params, truths, tracks))
                theirs = metric.theirs(stock)
                alone, batch = ours[name].time(repeat, options.min_seconds)
                found[name].append(
                    {
                        "stone_soup": stock.seconds,
                        "alone": alone,
                        "batch": batch,
                        "difference": largest_error(ours[name].result(repeat), theirs),
                        "values": sum(int(np.sum(~np.isnan(value))) for value in theirs.values()),
                    }
                )
                progress.advance(task)
    return [make_row(name, found[name], ours[name].compile_seconds) for name in METRICS]


def make_row(name: str, repeats: list[dict[str, float]], compile_seconds: float) -> dict[str, Any]:
    """What one metric gave; ratios are those of the medians."""
    sides = {
        side: spread([1e3 * repeat[side] for repeat in repeats]) for side in ("stone_soup", "alone", "batch")
    }
    theirs = sides["stone_soup"]["median"]
    return {
        "metric": name,
        "milliseconds": sides,
        "ratios": {side: theirs / sides[side]["median"] for side in ("alone", "batch")},
        "values": sum(repeat["values"] for repeat in repeats),
        "largest_difference": float(np.max([repeat["difference"] for repeat in repeats])),
        "compile_seconds": compile_seconds,
    }


HEADER = (
    "metric", "jaxtrack alone, ms", "in a batch, ms", "Stone Soup, ms", "ratio",
    "values compared", "largest difference", "compiled in",
)  # fmt: skip


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`; the ratios are to ours alone / in a batch."""
    return [
        row["metric"],
        *(with_spread(row["milliseconds"][side]) for side in ("alone", "batch", "stone_soup")),
        " / ".join(written(row["ratios"][side]) for side in ("alone", "batch")),
        f"{row['values']:,}",
        f"{row['largest_difference']:.1e}",
        f"{row['compile_seconds']:.1f} s",
    ]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(MetricsOptions(), argv, "python -m benchmarks.metrics")
    static, params = StaticParams(), Params()
    check(options, params)
    report, console = circumstances(), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, static, params, progress)
    largest, machine = float(np.max([row["largest_difference"] for row in rows])), report["machine"]
    same = largest <= TOLERANCE
    title = (
        f"median of {options.repeats} episodes of {options.steps} steps (smallest - largest); the values are "
        f"{'the same' if same else 'DIFFERENT'} (largest difference {largest:.1e}, allowed {TOLERANCE:.0e}); "
        f"float64, batches of {options.batch}; "
        f"{machine['processor']}, {machine['cores']} cores, {machine['jax_backend']}"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        scenario = {**vars(static), **vars(params)}
        write_report(options.out, report, options, scenario=scenario, largest_difference=largest, rows=rows)
    return 0 if same else DIFFERENT


if __name__ == "__main__":
    run(main)
