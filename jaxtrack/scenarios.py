"""Scenarios by name or from a file: the fields in which they differ from the paper's.

    env, params = jaxtrack.make(**read_scenario("clutter"))

All commands that play the environment take the same names and files as ``--scenario``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtrack.cli import read_config

SCENARIOS: dict[str, dict[str, Any]] = {
    "paper": {},
    "clutter": {"detection_probability": 0.9, "clutter_rate": 0.2},
    "births": {"initial_truths": 5, "birth_rate": 0.005, "death_probability": 0.0005},
    "agile": {"truth_process_noise": 400.0},
    "turning": {"truth_turn_rate": 1.0},
    "accelerating": {"truth_acceleration": 20.0},
    "crowd": {"num_truths": 20},
    "swarm": {"num_truths": 50, "max_tracks": 100, "max_detections": 20},
    "slow": {"time_step": 0.05},
    "flying": {"platform_speed": 200.0},
    "continuous": {"continuous_actions": True},
}
"""Scenarios by name: what differs from the paper's. The datasheet says what each is for."""

TABLES = ("static", "params")
"""Tables in which the fields of a TOML or JSON file may stand."""
RECORDING = ".csv"
"""Suffix of a file of OpenSky state vectors."""


def read_scenario(name: str) -> dict[str, Any]:
    """Fields of a scenario, for `jaxtrack.make`.

    Args:
        name: one of `SCENARIOS`; a .toml or .json file with fields of `Params` and `StaticParams`,
            alone or in tables `params` and `static`; or a .csv file of OpenSky state vectors, whose
            aircraft are then the truths.

    Raises:
        ValueError: naming the scenario, or the file and what is wrong with it.
    """
    if name in SCENARIOS:
        return SCENARIOS[name]
    if (suffix := Path(name).suffix) == RECORDING:
        return read_recording(Path(name))
    if suffix not in (".toml", ".json"):
        raise ValueError(
            f"scenario = {name!r}: expected {', '.join(SCENARIOS)}, or a .toml, .json or .csv file"
        )
    return {field: _frozen(value) for field, value in _without_tables(read_config(Path(name))).items()}


def read_recording(path: Path, **fields: Any) -> dict[str, Any]:
    """Fields of the scenario of a file of OpenSky state vectors.

    Args:
        path: the file.
        **fields: arguments of `jaxtrack.trajectories.scenario`.

    Raises:
        ValueError: naming the file and what is wrong with it.
    """
    from jaxtrack.trajectories import read_opensky, scenario

    try:
        return scenario(read_opensky(path), **fields)
    except OSError as error:
        raise ValueError(f"scenario = {str(path)!r}: {error.strerror}") from None


def _without_tables(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a file, those in tables and those that stand alone."""
    fields: dict[str, Any] = {}
    for name in TABLES:
        table = values.get(name, {})
        if not isinstance(table, Mapping):
            raise ValueError(f"{name} = {table!r}: expected a table of fields")
        fields |= table
    return fields | {name: value for name, value in values.items() if name not in TABLES}


def _frozen(value: Any) -> Any:
    """A tuple for a list: TOML and JSON have no tuples."""
    return tuple(value) if isinstance(value, list) else value
