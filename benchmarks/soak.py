"""Many millions of steps, with an eye on what must not happen: `python -m benchmarks.soak`."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
import math
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from benchmarks.soaking import CASES, SMALLEST_EIGENVALUE, Soaked
from jaxtrack.cli import (
    INTERRUPTED,
    parse,
    require_file,
    require_integer,
    require_positive,
    run,
    wide_console,
)
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table, write_report

VIOLATED = 1
MEGABYTE = 1e6
STATM = Path("/proc/self/statm")
WARM_UP = 3
"""Calls of each case after which memory counts."""


@dataclasses.dataclass(frozen=True)
class SoakOptions:
    """Plays the environment with friendly and hostile policies in turn, and checks every step.

    The exit code is 1 as soon as anything is not finite, a covariance is none, a function is traced
    twice, or memory grows. Ctrl-C ends it and reports what was checked so far.
    """

    steps: float = 1e8
    """Steps of all environments of all cases together; 1e8 takes minutes to an hour."""
    num_envs: int = 64
    """Environments stepped together."""
    steps_per_call: int = 500
    """Steps of each environment in one compiled call."""
    allowed_growth: float = 64.0
    """Largest growth of the process's memory after the warm-up (MB)."""
    seed: int = 0
    """Seed of everything."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


@dataclasses.dataclass
class Findings:
    """What a soak found.

    Attributes:
        cases: by name.
        violations: one line each; none is good.
        seconds: without compiling and warming up.
        steps: in these seconds.
        memory: resident megabytes after the warm-up and at the end.
        interrupted: whether Ctrl-C ended it.
    """

    cases: dict[str, Soaked]
    violations: list[str] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    steps: int = 0
    memory: tuple[float, float] = (math.nan, math.nan)
    interrupted: bool = False


def check(options: SoakOptions) -> None:
    """Raises ValueError, naming the option, before anything is played."""
    require_positive("steps", options.steps)
    require_integer("num_envs", options.num_envs, 1)
    require_integer("steps_per_call", options.steps_per_call, 2)
    require_positive("allowed_growth", options.allowed_growth)
    require_integer("seed", options.seed, 0)
    if options.out is not None:
        require_file("out", options.out)


def resident_memory() -> float:
    """Megabytes of this process in memory now; where the system does not tell, the most so far."""
    if STATM.exists():
        return int(STATM.read_text().split()[1]) * resource.getpagesize() / MEGABYTE
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MEGABYTE


def soak(options: SoakOptions, static: StaticParams, params: Params, progress: Progress) -> Findings:
    """Plays all cases in turn until the steps are done, something is wrong, or Ctrl-C."""
    sizes = (options.num_envs, options.steps_per_call)
    found = Findings({name: Soaked(case, static, params, *sizes) for name, case in CASES.items()})
    task = progress.add_task("compiling", total=options.steps)
    try:
        for number in range(WARM_UP):
            play_in_turn(found, options, number)
        memory, already, began = resident_memory(), played(found), time.perf_counter()
        found.memory = (memory, memory)
        progress.update(task, description="soaking", completed=already)
        while played(found) < options.steps and not found.violations:
            number += 1
            play_in_turn(found, options, number)
            found.seconds, found.steps = time.perf_counter() - began, played(found) - already
            found.memory = (memory, resident_memory())
            if found.memory[1] - memory > options.allowed_growth:
                found.violations.append(f"memory grew from {memory:,.0f} MB to {found.memory[1]:,.0f} MB")
            progress.update(task, completed=played(found))
    except KeyboardInterrupt:
        found.interrupted = True
    return found


def play_in_turn(found: Findings, options: SoakOptions, number: int) -> None:
    """One call of every case."""
    key = jax.random.fold_in(jax.random.key(options.seed), number)
    for (name, case), own in zip(found.cases.items(), jax.random.split(key, len(found.cases)), strict=True):
        found.violations += [f"{name}: {line}" for line in case.advance(own)]


def played(found: Findings) -> int:
    """Steps of all cases together."""
    return sum(case.steps for case in found.cases.values())


class Speed(ProgressColumn):
    """Steps per second."""

    def render(self, task: Task) -> Text:
        """Compiling counts as no step yet."""
        return Text(f"{task.speed:,.0f} steps/s" if task.speed else "compiling")


HEADER = (
    "case", "steps", "smallest eigenvalue / trace", "most live tracks", "dropped tracks", "traces",
)  # fmt: skip


def make_row(name: str, case: Soaked) -> dict[str, Any]:
    """What one case gave."""
    return {
        "case": name,
        "steps": case.steps,
        "smallest_eigenvalue": case.smallest_eigenvalue if case.steps else None,
        "most_live_tracks": case.most_live,
        "dropped_tracks": case.dropped,
        "traces": case.traces,
    }


def cells(row: dict[str, Any]) -> list[str]:
    """The row under `HEADER`."""
    smallest = row["smallest_eigenvalue"]
    return [
        row["case"],
        f"{row['steps']:,}",
        "" if smallest is None else f"{smallest:.1e}",
        str(row["most_live_tracks"]),
        f"{row['dropped_tracks']:,}",
        str(row["traces"]),
    ]


def title_of(found: Findings, machine: dict[str, Any]) -> str:
    """What was found, in words."""
    end = "interrupted; " if found.interrupted else ""
    verdict = "VIOLATED: " + "; ".join(found.violations) if found.violations else "nothing was wrong"
    speed = found.steps / found.seconds if found.seconds else 0.0
    return (
        f"{end}{played(found):,} steps: {verdict}; "
        f"memory {found.memory[0]:,.0f} MB after the warm-up, {found.memory[1]:,.0f} MB at the end; "
        f"{speed:,.0f} steps/s; {machine['processor']}, {jax.device_count()} of {machine['cores']} cores, "
        f"{machine['jax_backend']}"
    )


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(SoakOptions(), argv, "python -m benchmarks.soak")
    check(options)
    static, params = StaticParams(), Params()
    report, console = circumstances(), wide_console()
    columns = (TextColumn("{task.description}"), BarColumn(), Speed(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        found = soak(options, static, params, progress)
    rows = [make_row(name, case) for name, case in found.cases.items()]
    title = title_of(found, report["machine"])
    print_table(HEADER, [cells(row) for row in rows], title, options.markdown, console)
    if options.out is not None:
        left = {name: value for name, value in vars(found).items() if name not in ("cases", "steps")}
        limits = {"smallest_eigenvalue": SMALLEST_EIGENVALUE}
        write_report(options.out, report, options, limits=limits, **left, steps=played(found), rows=rows)
    if found.violations:
        return VIOLATED
    return INTERRUPTED if found.interrupted else 0


if __name__ == "__main__":
    run(main)
