"""Which package may import which, and what a bare import costs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"stonesoup", "matplotlib", "gymnasium", "stable_baselines3", "torch"}


def imported_packages(folder):
    """Top-level packages that the files of a folder import anywhere, also inside functions."""
    packages = set()
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                packages |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: relative import"
                packages.add(node.module.split(".")[0])
    return packages


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("jaxtrack", {"reference", "train", "benchmarks", "tests", "stonesoup"}),
        ("train", {"reference", "tests", "stonesoup"}),
        ("reference", {"train", "tests"}),
    ],
)
def test_arrows_between_packages_point_one_way(folder, forbidden):
    packages = imported_packages(folder)
    assert "jaxtrack" in packages
    assert not packages & forbidden


def test_only_modules_for_stable_baselines3_import_it():
    folders = ("jaxtrack", "reference", "train", "benchmarks")
    paths = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    words = ("import torch", "from torch", "import stable_baselines3", "from stable_baselines3")
    importing = {
        str(path.relative_to(ROOT))
        for path in paths
        if any(line.strip().startswith(words) for line in path.read_text().splitlines())
    }
    benchmarks = {"benchmarks/torch_learner.py", "benchmarks/stone_soup_ppo.py"}
    assert importing == {"jaxtrack/sb3.py", *benchmarks}


def modules_after(statement):
    """Top-level modules loaded in a fresh interpreter by one statement."""
    code = f"{statement}; import sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(result.stdout.split())


def test_a_bare_import_loads_nothing_heavy():
    loaded = modules_after("import jaxtrack, jaxtrack.tracker, jaxtrack.metrics, jaxtrack.reward")
    assert "jax" in loaded
    assert not loaded & HEAVY


def test_the_environment_is_loaded_on_first_use():
    loaded = modules_after("import jaxtrack; assert jaxtrack.ENV_ID == 'SearchTrack-v0'")
    assert "gymnax" in loaded
    # gymnax itself brings Gymnasium and matplotlib along.
    assert not loaded & {"stonesoup", "stable_baselines3", "torch"}


def test_every_public_name_exists():
    import jaxtrack

    assert all(hasattr(jaxtrack, name) for name in jaxtrack.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = jaxtrack.nonsense
