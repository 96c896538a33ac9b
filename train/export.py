"""A trained run as two small files, to keep or to share.

`python -m train.export --run runs/beams-seed0 --out agents/beams` writes configuration and weights: 50 kB,
1 MB with NatureCNN.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jaxtrack.cli import parse, run
from train.saved_run import AGENT, read_run, save_agent


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Writes the configuration and the weights of a run, for `python -m train.evaluate --run`."""

    run: Path = Path()
    """Folder of the run."""
    out: Path = Path()
    """Folder for the agent, which must hold none yet."""


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(ExportOptions(), argv, "python -m train.export")
    for name in ("run", "out"):
        if getattr(options, name) == Path():
            raise ValueError(f"{name}: expected a folder, --{name} FOLDER")
    if (options.out / AGENT).exists():
        raise ValueError(f"out = {str(options.out)!r}: expected a folder without {AGENT}")
    save_agent(read_run(options.run), options.out)
    size = sum((options.out / name).stat().st_size for name in (AGENT, "config.json"))
    print(f"{options.out}: {size / 1000:.0f} kB; play it with: python -m train.evaluate --run {options.out}")
    return 0


if __name__ == "__main__":
    run(main)
