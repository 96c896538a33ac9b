"""The datasheet's table of scenarios: `python -m train.scenario_table` plays rules on each of them."""

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtrack.cli import parse, require_file, require_integer, run, wide_console
from jaxtrack.params import Params
from jaxtrack.policies import POLICIES
from jaxtrack.report import circumstances, markdown_table
from jaxtrack.scenarios import SCENARIOS, read_scenario
from jaxtrack.validation import with_unit
from train.evaluate import COMPARED_SEED, LARGEST_EPISODES, baselines, play
from train.results import format_estimate
from train.scenarios import build_scenario
from train.statistics import mean, resample

BEGIN, END = "<!-- scenarios: begin -->", "<!-- scenarios: end -->"
PROG = "python -m train.scenario_table"


@dataclasses.dataclass(frozen=True)
class Options:
    """Plays rules on every scenario and prints GOSPA (m) as a Markdown table."""

    scenarios: tuple[str, ...] = tuple(SCENARIOS)
    """Scenarios by name or file, as in train.evaluate."""
    policies: tuple[str, ...] = ("random", "index_tuned", "sweep", "sweep_then_track")
    """Baselines by name."""
    episodes: int = 50
    """Episodes of each policy on each scenario; all policies meet the same ones."""
    seed: int = COMPARED_SEED
    """Seed of the episodes."""
    page: Path | None = None
    """File in which to replace the table, between its two marks; unset, it is only printed."""


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(Options(), argv, PROG)
    check(options)
    started = time.perf_counter()
    rows = []
    for number, name in enumerate(options.scenarios, start=1):
        rows.append(row(name, options))
        done = f"{number}/{len(options.scenarios)} {name}: {(time.perf_counter() - started) / 60:.1f} min"
        print(done, file=sys.stderr, flush=True)
    table = markdown_table(["scenario", "what differs from `paper`", *options.policies], rows)
    made = f"{table}\n\n{made_with(options, argv, time.perf_counter() - started)}"
    print(made)
    if options.page is not None:
        replace(options.page, made)
    return 0


def check(options: Options) -> None:
    """Raises ValueError, in one line, for options that make no sense."""
    require_integer("episodes", options.episodes, 1, LARGEST_EPISODES)
    for name in options.policies:
        if name not in POLICIES:
            raise ValueError(f"policies = {name!r}: expected some of {', '.join(POLICIES)}")
    for name in options.scenarios:
        read_scenario(name)
    if options.page is not None:
        require_file("page", options.page)
        split(options.page)


def row(name: str, options: Options) -> list[str]:
    """A line of the table: name, fields, and the GOSPA of every policy with its 95 % interval."""
    env, params = build_scenario(name, [])
    console = wide_console()
    comparison = play(baselines(options.policies), env, params, options.episodes, options.seed, console)
    drawn = resample(options.episodes)
    found = [mean(comparison.played[policy].values["gospa"], drawn) for policy in options.policies]
    return [f"`{name}`", in_words(read_scenario(name)), *map(format_estimate, found)]


def in_words(fields: Mapping[str, Any]) -> str:
    """Fields and values with their units."""
    quantities = {field.name: field for field in dataclasses.fields(Params) if "unit" in field.metadata}
    words = []
    for name, value in fields.items():
        value = "recorded" if name == "trajectories" else value
        number = f"{value:g}" if isinstance(value, float) else str(value)
        words.append(f"`{name}` {with_unit(number, quantities[name]) if name in quantities else number}")
    return ", ".join(words) or "–"  # noqa: RUF001


def made_with(options: Options, argv: Sequence[str], seconds: float) -> str:
    """What the numbers are, and how they were made."""
    found = circumstances(("jax", "numpy"))
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    return (
        f"GOSPA (m, c = 200 m except where a scenario says otherwise), mean over {options.episodes} episodes "
        f"± half of the 95 % interval. `{' '.join([PROG, *argv])}`: {seconds / 60:.0f} min on "
        f"{found['machine']['cores']} core(s) of {found['machine']['processor']}, {versions}."
    )


def split(page: Path) -> tuple[str, str]:
    """What stands before and after the table of a page.

    Raises:
        ValueError: naming the page, if it has not both marks, in order.
    """
    before, begin, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"page = {str(page)!r}: expected the marks {BEGIN} and {END}")
    return before, after


def replace(page: Path, table: str) -> None:
    """Puts the table between the marks of the page."""
    before, after = split(page)
    page.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    run(main)
