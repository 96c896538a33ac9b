"""Runs a command in a Python that lacks a module."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name == {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
sys.argv = [{command!r}]
from jaxtrack.cli import run
from {command} import main
run(main)
"""


def run_without(missing: str, command: str) -> subprocess.CompletedProcess[str]:
    """Runs `python -m command` where the module `missing` can not be found."""
    code = WITHOUT.format(missing=missing, command=command)
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
