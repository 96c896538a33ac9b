"""What every command reports beside its figures, and how tables are printed."""

import json
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrack import cores

OUTPUT_OPTIONS = ("out", "figure", "markdown")
PACKAGES = ("jaxtrack", "jax", "jaxlib", "gymnax", "numpy", "stonesoup")


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, smallest and largest of the repeats, and all of them."""
    return {
        "median": float(np.median(values)),
        "min": min(values),
        "max": max(values),
        "repeats": list(values),
    }


def written(number: float) -> str:
    """A number with at least three digits."""
    return f"{number:,.0f}" if number >= 100 else f"{number:#.3g}"


def with_spread(values: dict[str, Any]) -> str:
    """Median (smallest - largest) of `spread`."""
    return "{} ({} - {})".format(*(written(values[which]) for which in ("median", "min", "max")))


def write_report(file: Path, report: dict[str, Any], options: Any, **found: Any) -> None:
    """Writes a JSON file: the circumstances, the options that are not about output, and what was found."""
    asked = {name: value for name, value in vars(options).items() if name not in OUTPUT_OPTIONS}
    file.write_text(json.dumps({**report, "options": asked, **found}, indent=2, default=str) + "\n")


def circumstances(packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """Date, versions of the packages, and machine; no names of hosts, users or folders."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **versions(packages)},
        "machine": {
            "processor": processor(),
            "cores": cores.available(),
            "system": platform.system(),
            "jax_backend": jax.default_backend(),
        },
    }


def versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Versions of the packages that figures depend on, as far as they are installed."""
    found = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def processor() -> str:
    """The processor's name, or its kind where the system does not tell."""
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def print_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], title: str, markdown: bool, console: Console
) -> None:
    """Prints a table for the terminal, or in Markdown."""
    if markdown:
        print(markdown_table(header, rows))
        print(f"\n{title}")
        return
    table = Table(*header, title=title)
    for line in rows:
        table.add_row(*line)
    console.print(table)


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in [header, ["---"] * len(header), *rows])
