"""The results as they are written: of a whole run, or with one row of it measured again."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from jaxtrack.report import circumstances
from reference.parity.rows import Row

Results = dict[str, Any]


def results(asked: dict[str, Any], rows: list[Row], divergences: list[str], seconds: float) -> Results:
    """What is written of a run with the options `asked`."""
    return {
        **circumstances(),
        "options": asked,
        "seconds": round(seconds, 1),
        "rows": [dataclasses.asdict(row) | {"passed": row.passed} for row in rows],
        "divergences": divergences,
    }


def table_of(found: Results) -> list[Row]:
    """The rows of results."""
    names = [field.name for field in dataclasses.fields(Row)]
    return [Row(**{name: row[name] for name in names}) for row in found["rows"]]


def read_results(path: Path, asked: dict[str, Any], component: str) -> Results:
    """Results of a whole run that a row measured now can be put into.

    Raises:
        ValueError: naming what hinders it: there is no such row, or it was measured with other options
            or other packages than it would be now.
    """
    try:
        found = json.loads(path.read_text())
        components = [row["component"] for row in found["rows"]]
        options, versions = dict(found["options"]), dict(found["versions"])
    except (OSError, ValueError, KeyError, TypeError):
        raise ValueError(f"out = {str(path)!r}: expected the results of a whole run") from None
    if component not in components:
        raise ValueError(f"out = {str(path)!r}: it has no row of {component}")
    before = options | versions
    for name, value in (asked | circumstances()["versions"]).items():
        if name != "processes" and before.get(name) != value:
            raise ValueError(f"{name} = {value}: {path} was measured with {before.get(name)}")
    return found


def with_row(written: Results, again: Results, component: str, named: str) -> Results:
    """The written results with the one row of others in place of theirs, and its divergences.

    Args:
        written: of a whole run.
        again: with the new row alone.
        component: whose row it is.
        named: how the lines of its divergences begin.
    """
    (row,) = again["rows"]
    lines = [line for line in written["divergences"] if not line.startswith(named)]
    # Those of the environment come last.
    place = next((n for n, line in enumerate(lines) if line.startswith("environment")), len(lines))
    earlier = [one for one in written.get("again", []) if one["component"] != component]
    return {
        **written,
        "rows": [row if old["component"] == component else old for old in written["rows"]],
        "divergences": [*lines[:place], *again["divergences"], *lines[place:]],
        "again": [*earlier, {"component": component, "date": again["date"], "seconds": again["seconds"]}],
    }


def line_below(found: Results) -> str:
    """What was run, for beneath the table."""
    asked = found["options"]
    versions = ", ".join(f"{name} {found['versions'][name]}" for name in ("python", "jax", "stonesoup"))
    size = f"{asked['scenarios'] * asked['steps']:,} steps one by one, {asked['episodes']:,} whole episodes"
    again = "".join(f"; `{one['component']}` again {one['date'][:10]}" for one in found.get("again", []))
    machine = f"{found['machine']['cores']} cores, {found['seconds'] / 60:.0f} min"
    return f"{size}; {versions}; {machine}{again}."
