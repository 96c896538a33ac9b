"""What one more environment, track slot, truth ... costs: `python -m benchmarks.scaling`."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import jax
from rich.progress import Progress

from benchmarks.operations import mean_seconds
from benchmarks.playing import begin, compile_play, pointing
from benchmarks.scaling_fit import AXES, Axis, draw, fit
from jaxtrack.cli import parse, require_file, require_integer, require_positive, run, wide_console
from jaxtrack.env import LARGEST_IN_ONE_KERNEL, make
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, spread, write_report, written

FIGURES = (".png", ".svg", ".pdf")
WARM_UP = 2
"""Looks at every truth, from the start of an episode, before anything is timed: they make the tracks."""


@dataclasses.dataclass(frozen=True)
class ScalingOptions:
    """Times a step of the environment along one axis of the scenario at a time, around the default.

    Looks point at the truths in turn, as in `benchmarks.environment`: the expensive case.
    """

    num_envs: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    """Numbers of environments stepped together; the one nearest to 64 is kept on the other axes."""
    max_tracks: tuple[int, ...] = (10, 20, 40, 80, 160)
    """Numbers of track slots."""
    max_detections: tuple[int, ...] = (5, 10, 20, 40)
    """Numbers of detection slots."""
    num_truths: tuple[int, ...] = (5, 10, 20, 40)
    """Numbers of truths."""
    map_size: tuple[int, ...] = (24, 48, 96, 192)
    """Pixels along each side of the scan map."""
    repeats: int = 5
    """Times that everything is timed."""
    steps: int = 50
    """Steps in one call."""
    min_seconds: float = 0.2
    """Every case is called again and again for at least this long in one repeat (s)."""
    seed: int = 0
    """Seed of the scenarios."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    figure: Path | None = None
    """Picture of all costs (.png, .svg or .pdf); none is drawn without it."""
    markdown: bool = False
    """Print the table in Markdown."""


@dataclasses.dataclass(frozen=True)
class Case:
    """What is timed: shapes, number of environments and of devices that share them."""

    static: StaticParams
    num_envs: int
    devices: int = 1


def check(options: ScalingOptions, params: Params) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    for name in ("num_envs", "max_tracks", "max_detections", "num_truths", "map_size"):
        values = getattr(options, name)
        if len(set(values)) < 2 or len(set(values)) < len(values):
            raise ValueError(f"{name} = {values}: expected at least two different numbers")
        low = 2 if name == "map_size" else 1
        require_integer(name, min(values), low)
        require_integer(name, max(values), low, LARGEST_IN_ONE_KERNEL.get(name))
    for name, low in (("repeats", 1), ("seed", 0)):
        require_integer(name, getattr(options, name), low)
    require_integer("steps", options.steps, 1, params.max_steps_in_episode // 4)
    require_positive("min_seconds", options.min_seconds)
    for name in ("out", "figure"):
        if (path := getattr(options, name)) is not None:
            require_file(name, path)
    if options.figure is not None and options.figure.suffix not in FIGURES:
        raise ValueError(f"figure = {str(options.figure)!r}: expected a file ending in {', '.join(FIGURES)}")


def cases_along(axis: Axis, options: ScalingOptions, static: StaticParams) -> dict[int, Case]:
    """The cases of one axis by value; everything else is as in the default scenario."""
    num_envs = min(options.num_envs, key=lambda count: abs(count - 64))
    if axis.name == "devices":
        usable = sorted({1, jax.device_count()})
        return {count: Case(static, num_envs, count) for count in usable if num_envs % count == 0}
    values = sorted(getattr(options, axis.name))
    if axis.name == "num_envs":
        return {count: Case(static, count) for count in values}
    return {value: Case(dataclasses.replace(static, **{axis.name: value}), num_envs) for value in values}


class Program:
    """A piece of an episode compiled for one case, and where it starts.

    Attributes:
        compile_seconds: what compiling took (s).
        live_tracks: mean number of live tracks while it is timed.
    """

    def __init__(self, case: Case, params: Params, options: ScalingOptions) -> None:
        env, self.params = make(params, case.static)
        self.num_envs, self.steps = case.num_envs, options.steps
        self.keys = jax.random.split(jax.random.key(options.seed), case.num_envs)
        start = jax.jit(lambda keys, params: begin(keys, params, env))(self.keys, self.params)
        self.compiled, self.compile_seconds = compile_play(
            env, self.params, start, pointing, options.steps, shared=case.devices > 1
        )
        for _ in range(-(-WARM_UP * case.static.num_truths // options.steps)):
            start, logged = self.compiled(self.keys, start, self.params)
        self.start, self.live_tracks = start, float(logged["live_tracks"].mean())

    def time(self, min_seconds: float) -> float:
        """Time of one step of all environments (µs), from the same start again and again."""
        seconds = mean_seconds(lambda: self.compiled(self.keys, self.start, self.params), min_seconds)
        return 1e6 * seconds / self.steps


def measure(
    options: ScalingOptions, static: StaticParams, params: Params, progress: Progress
) -> list[dict[str, Any]]:
    """Times all cases in turns, so that whatever else the machine does hits all.

    Returns:
        One row for each axis.
    """
    along = {axis: cases_along(axis, options, static) for axis in AXES}
    different = list(dict.fromkeys(case for cases in along.values() for case in cases.values()))
    task = progress.add_task("compiling", total=len(different) * (1 + options.repeats))
    programs = {}
    for case in different:
        programs[case] = Program(case, params, options)
        progress.advance(task)
    progress.update(task, description="measuring")
    times: dict[Case, list[float]] = {case: [] for case in different}
    for _, case in product(range(options.repeats), different):
        times[case].append(programs[case].time(options.min_seconds))
        progress.advance(task)
    return [make_row(axis, cases, times, programs) for axis, cases in along.items()]


def make_row(
    axis: Axis, cases: dict[int, Case], times: dict[Case, list[float]], programs: dict[Case, Program]
) -> dict[str, Any]:
    """What one axis gave; the line goes through the smallest of the repeats, None where there is none.

    Other work on the machine only ever adds to a time, and small differences of large times are asked for.
    """
    shares = {value: 1 if axis.per_step_of_all else case.num_envs for value, case in cases.items()}
    costs = [spread([time / shares[value] for time in times[case]]) for value, case in cases.items()]
    units = [value**axis.power for value in cases]
    return {
        "axis": axis.name,
        "unit": axis.unit,
        "values": list(cases),
        "microseconds": costs,
        "per_step_of": "all environments" if axis.per_step_of_all else "one environment",
        "fit": fit(units, [cost["min"] for cost in costs]) if axis.line else None,
        "live_tracks": [programs[case].live_tracks for case in cases.values()],
        "compile_seconds": [programs[case].compile_seconds for case in cases.values()],
    }


HEADER = ("one more", "costs, µs per step", "of", "fixed, µs", "largest misfit", "measured: value: µs")


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`."""
    pairs = zip(row["values"], row["microseconds"], strict=True)
    measured = ", ".join(f"{value:,}: {written(cost['min'])}" for value, cost in pairs)
    found = row["fit"]
    line = [f"{found['one_more']:#.3g}", row["per_step_of"], f"{found['fixed']:#.3g}"] if found else [""] * 3
    return [row["unit"], *line, f"{found['largest_misfit']:.0%}" if found else "", measured]


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(ScalingOptions(), argv, "python -m benchmarks.scaling")
    static, params = StaticParams(), Params()
    check(options, params)
    report, console = circumstances(), wide_console()
    with Progress(console=console, disable=not console.is_terminal) as progress:
        rows = measure(options, static, params, progress)
    machine = report["machine"]
    title = (
        f"smallest of {options.repeats} repeats, pointing looks, one device but for the last row; "
        f"{machine['processor']}, {machine['cores']} cores, {machine['jax_backend']}, "
        f"jax {report['versions']['jax']}"
    )
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.figure is not None:
        draw(rows, options.figure, title)
    if options.out is not None:
        write_report(options.out, report, options, scenario={**vars(static), **vars(params)}, rows=rows)
    return 0


if __name__ == "__main__":
    run(main)
