"""Scenarios by name or from a file, in which policies are compared."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxtrack.cli import read_config
from jaxtrack.env import SearchTrack, make
from jaxtrack.params import Params, StaticParams
from train.config import TrainConfig, from_dict

SCENARIOS: dict[str, dict[str, Any]] = {
    "paper": {},
    "clutter": {"detection_probability": 0.9, "clutter_rate": 0.2},
    "slow": {"time_step": 0.05},
    "crowd": {"num_truths": 20},
    "agile": {"truth_process_noise": 400.0},
    "births": {"initial_truths": 5, "birth_rate": 0.005, "death_probability": 0.0005},
}
"""Scenarios by name: what differs from the paper's."""

TABLES = ("static", "params")


def build_scenario(name: str, runs: Sequence[TrainConfig]) -> tuple[SearchTrack, Params]:
    """The environment and its numbers, checked.

    Args:
        name: of a scenario or a file; empty for that of the runs, or the paper's without one.
        runs: configurations of the runs.

    Raises:
        ValueError: naming what is wrong; also if no scenario is named and the runs have several.
    """
    if not name and runs:
        static, params = runs[0].static, runs[0].params
        if any((run.static, run.params) != (static, params) for run in runs):
            raise ValueError("scenario: expected one by name, the runs were trained on different ones")
        return make(params, static)
    values = SCENARIOS.get(name or "paper")
    if values is None:
        if Path(name).suffix not in (".toml", ".json"):
            raise ValueError(
                f"scenario = {name!r}: expected {', '.join(SCENARIOS)}, or a .toml or .json file"
            )
        values = read_config(Path(name))
    config = from_dict(sort_fields(values))
    return make(config.params, config.static)


def sort_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a scenario as the tables `static` and `params`, in which they may already be."""
    shapes = {field.name for field in dataclasses.fields(StaticParams)}
    tables: dict[str, Any] = {name: values.get(name, {}) for name in TABLES}
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            raise ValueError(f"{name} = {table!r}: expected a table of fields")
    for name, value in values.items():
        if name not in TABLES:
            table = "static" if name in shapes else "params"
            tables[table] = {**tables[table], name: value}
    return tables
