"""The benchmarks in ten minutes, one after the other: `python -m benchmarks`, or `make bench`."""

import dataclasses
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.progress import Progress, TimeElapsedColumn

from jaxtrack.cli import parse, run, wide_console

FAILED = 1
TABLES = "tables.md"

PARTS: dict[str, tuple[str, ...]] = {
    "environment": ("benchmarks.environment",),
    "tracker": ("benchmarks.tracker", "--tracks", "10", "100"),
    "metrics": ("benchmarks.metrics", "--steps", "300"),
    "planning": ("benchmarks.planning", "--candidates", "8", "--horizons", "10"),
    "tracking": ("benchmarks.tracking", "--detections", "100000", "--stone-soup-seconds", "10"),
}
"""Module and options of every part. Each has a process of its own: JAX counts its devices only once."""


@dataclasses.dataclass(frozen=True)
class BenchOptions:
    """Runs a selection of the benchmarks and keeps their results; a part that fails stops no other.

    Every part leaves a JSON file in the folder, and `tables.md` holds all tables. The exit code is 1
    if a part failed or found that the two sides differ.
    """

    out: Path = Path("bench")
    """Folder for the results; made if it is not there."""
    parts: tuple[str, ...] = tuple(PARTS)
    """What to run, in this order."""


def check(options: BenchOptions) -> None:
    """Raises ValueError, naming the option, before anything is run."""
    if not options.parts or len(set(options.parts)) < len(options.parts):
        raise ValueError(f"parts = {options.parts}: expected different names")
    for part in options.parts:
        if part not in PARTS:
            raise ValueError(f"parts = {part!r}: expected any of {', '.join(PARTS)}")
    if "\0" in str(options.out) or (options.out.exists() and not options.out.is_dir()):
        raise ValueError(f"out = {str(options.out)!r}: expected a folder")


def run_part(part: str, folder: Path) -> tuple[bool, str]:
    """Runs one part.

    Returns:
        Whether it went well, and its section of the tables: what it printed, or why it failed.
    """
    file = folder / f"{part}.json"
    file.unlink(missing_ok=True)  # a failure must not leave an older result behind
    command = [sys.executable, "-m", *PARTS[part], "--markdown", "--out", str(file)]
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - began
    lines = [f"## {part}", "", f"`python -m {' '.join(PARTS[part])}`, {seconds:.0f} s", ""]
    if done.returncode:
        said = done.stderr.strip().splitlines()
        lines += [f"FAILED with exit code {done.returncode}{': ' + said[-1] if said else ''}", ""]
    return not done.returncode, "\n".join([*lines, done.stdout.strip(), ""])


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(BenchOptions(), argv, "python -m benchmarks")
    check(options)
    options.out.mkdir(parents=True, exist_ok=True)
    console, failed, sections = wide_console(), list[str](), ["# Benchmarks\n"]
    columns = (*Progress.get_default_columns(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=len(options.parts))
        for part in options.parts:
            progress.update(task, description=part)
            well, section = run_part(part, options.out)
            failed += [] if well else [part]
            sections.append(section)
            # Written after every part, so that an interrupted run has what was measured.
            (options.out / TABLES).write_text("\n".join(sections))
            progress.console.print(section, markup=False, highlight=False)
            progress.advance(task)
    print(f"results are in {options.out}; " + (f"FAILED: {', '.join(failed)}" if failed else "all went well"))
    return FAILED if failed else 0


if __name__ == "__main__":
    run(main)
