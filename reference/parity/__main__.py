"""Measures how equal both sides are: `python -m reference.parity [--quick] [--readme README.md]`."""

import dataclasses
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from jaxtrack import cores
from jaxtrack.cli import parse, require_file, require_integer, run, wide_console
from reference.parity.environment import environment_rows
from reference.parity.free_running import free_running_rows
from reference.parity.metrics import COMPARISONS, metric_rows
from reference.parity.models import NUM_MODELS, model_rows
from reference.parity.oracle import Job, run_all
from reference.parity.parts import PARTS, divergences_of, part_rows
from reference.parity.records import random_records
from reference.parity.rows import Row
from reference.parity.scenarios import random_scenario
from reference.parity.stepwise import component_rows
from reference.parity.table import print_rows, write_readme
from reference.parity.written import line_below, read_results, results, table_of, with_row

Item = TypeVar("Item")


@dataclasses.dataclass(frozen=True)
class ParityOptions:
    """Compares every component, whole episodes, metrics and the environment with stock Stone Soup.

    Exit code 1 if anything differs by more than it may.
    """

    quick: bool = False
    """A small selection, about a minute; the other sizes are then ignored."""
    episodes: int = 1000
    """Free-running random episodes."""
    scenarios: int = 220
    """Random scenarios that are compared step by step, every intermediate."""
    steps: int = 50
    """Steps of each episode and scenario."""
    part_episodes: int = 50
    """Free-running random episodes with each of the parts beside the default ones."""
    samples: int = 2000
    """Random inputs of each model, measure and sensor."""
    records: int = 50
    """Random records on which the metrics are compared."""
    environments: int = 12
    """Episodes of the two environments from the same draws, 200 steps each, the rewards in turn."""
    seed: int = 0
    """Number of the first random scenario."""
    processes: int = 0
    """Processes for Stone Soup; 0 takes one per core."""
    only: str | None = None
    """Component of one of the parts beside the default ones, as in the table: only its row is measured, and
    replaces the one in `out`, which the same options and versions must have made."""
    out: Path = Path("parity.json")
    """Results in full."""
    readme: Path | None = None
    """Markdown file whose parity table, between its two marks, is replaced."""


QUICK: dict[str, Any] = {
    "episodes": 12,
    "scenarios": 8,
    "steps": 40,
    "part_episodes": 2,
    "samples": 60,
    "records": 3,
    "environments": 4,
}


def check(options: ParityOptions) -> None:
    """Raises ValueError, naming the option, before anything is computed."""
    for name in QUICK:
        require_integer(name, getattr(options, name), 1)
    for name in ("seed", "processes"):
        require_integer(name, getattr(options, name), 0)
    require_file("out", options.out)
    components = [part.component for part in PARTS]
    if options.only is not None and options.only not in components:
        raise ValueError(f"only = {options.only!r}: expected one of {'; '.join(components)}")
    if options.readme is not None and not options.readme.is_file():
        raise ValueError(f"readme = {str(options.readme)!r}: no such file")


def asked(options: ParityOptions) -> dict[str, Any]:
    """The options that results depend on, and the number of processes."""
    return {name: value for name, value in vars(options).items() if name not in ("only", "out", "readme")}


def measure(options: ParityOptions, progress: Progress) -> tuple[list[Row], list[str]]:
    """All rows of the table, or the one asked for, and every first divergence in one line."""
    processes = options.processes or cores.available()

    def follow(items: Iterable[Item], total: int, what: str) -> Iterator[Item]:
        if progress.disable:  # in a log, a line where a bar would begin
            print(f"{what}: {total}", file=sys.stderr, flush=True)
        yield from progress.track(items, total=total, description=what)

    def measure_parts() -> tuple[list[Row], list[str]]:
        parts = [part for part in PARTS if options.only in (None, part.component)]
        return part_rows(parts, options.seed, options.part_episodes, options.steps, processes, follow)

    if options.only is not None:
        return measure_parts()
    first, last = options.seed, options.seed + options.scenarios
    scenarios = [random_scenario(seed, options.steps) for seed in range(first, last)]
    jobs = [Job(scenario, intermediates=True) for scenario in scenarios]
    records = follow(run_all(jobs, processes), len(jobs), "components, step by step")
    rows = component_rows(zip(scenarios, records, strict=True))

    seeds = range(last, last + options.episodes)
    episodes, divergences = free_running_rows(seeds, options.steps, processes, follow)
    rows += episodes

    parts, lines = measure_parts()
    rows += parts
    divergences += lines

    models = model_rows(options.seed, options.samples)
    rows += follow(models, NUM_MODELS, "models, measures, sensor")
    metrics = metric_rows(random_records(options.seed, options.records))
    rows += follow(metrics, len(COMPARISONS), "metrics")
    seeds = range(options.environments)
    environments, differing = environment_rows(follow(seeds, len(seeds), "environments"), steps=200)
    divergences += [f"environment: {divergence}" for divergence in differing]
    return rows + environments, divergences


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(ParityOptions(), argv, "python -m reference.parity")
    if options.quick:
        options = dataclasses.replace(options, **QUICK)
    check(options)
    written = None if options.only is None else read_results(options.out, asked(options), options.only)
    jax.config.update("jax_enable_x64", True)
    started = time.perf_counter()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        rows, divergences = measure(options, progress)
    seconds = time.perf_counter() - started

    print_rows(rows, wide_console())
    for line in divergences:
        print(line)
    found = results(asked(options), rows, divergences, seconds)
    if written is not None and options.only is not None:
        found = with_row(written, found, options.only, divergences_of(options.only))
    table = table_of(found)
    failed = [row for row in table if not row.passed]
    for row in failed:
        print(f"FAILED: {row.component} against {row.stone_soup}: {row.float64}, {row.agreement}")
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    if options.readme is not None:
        write_readme(options.readme, table, line_below(found))
    print(f"{options.out}: {len(table)} rows, {len(failed)} failed, {seconds:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    run(main)
