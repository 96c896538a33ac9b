"""What every benchmark reports beside its figures, and how tables are printed."""

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

PACKAGES = ("jaxtrack", "jax", "jaxlib", "gymnax", "numpy", "stonesoup")


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, smallest and largest of the repeats, and all of them."""
    return {
        "median": float(np.median(values)),
        "min": min(values),
        "max": max(values),
        "repeats": list(values),
    }


def circumstances() -> dict[str, Any]:
    """Date, versions and machine; no names of hosts, users or folders."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "machine": {
            "processor": processor(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "system": platform.system(),
            "jax_backend": jax.default_backend(),
        },
    }


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
        lines = [header, ["---"] * len(header), *rows]
        print("\n".join(f"| {' | '.join(line)} |" for line in lines))
        print(f"\n{title}")
        return
    table = Table(*header, title=title)
    for line in rows:
        table.add_row(*line)
    console.print(table)
