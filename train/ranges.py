"""Tables of numbers that change during a training, by name from one value to another: what may stand in them.

`curriculum` and `randomise` of a training's configuration are such tables; `train/varied.py` uses them.
"""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, get_args

import numpy as np

from jaxtrack.params import Params, StaticParams
from jaxtrack.validation import validate
from train.tables import read_number, table_option

FIXED = ("field_limit", "beam_azimuth", "beam_elevation", "max_steps_in_episode", "trajectories")
"""Numbers that say what an action or an episode is; they stay as they are during a training."""
CHANGEABLE = tuple(sorted(field.name for field in dataclasses.fields(Params) if field.name not in FIXED))
COUNTS = tuple(
    field.name for field in dataclasses.fields(Params) if int in (get_args(field.type) or [field.type])
)
"""Numbers that are whole."""


def _read_ends(text: str) -> tuple[float, float]:
    low, high = map(read_number, text.split(":"))
    return low, high


def _write_ends(ends: tuple[float, float]) -> str:
    return f"{ends[0]}:{ends[1]}"


Ranges = Annotated[
    dict[str, tuple[float, float]],
    table_option("NAME=FROM:TO", "clutter_rate=0:0.2", _read_ends, _write_ends),
]
"""Names of numbers to their two ends; a table of pairs in TOML and JSON, words on the command line."""


def check_ranges(
    tables: Mapping[str, Mapping[str, tuple[float, float]]], static: StaticParams, params: Params
) -> None:
    """Refuses tables with which an environment could not run at every moment of a training.

    Raises:
        ValueError: one line that names the table, the number, and what is allowed.
    """
    changing: dict[str, tuple[float, float]] = {}
    for table, ranges in tables.items():
        for name, ends in ranges.items():
            _check_range(f"{table}.{name}", name, ends, static, params)
            if name in changing:
                raise ValueError(f"{table}.{name}: expected in one table only, it stands in two")
            changing[name] = ends
    # Every two numbers meet with each of their ends; here it shows if they do not go together.
    apart: dict[str, Any] = {
        name: np.reshape(ends, [2, *[1] * place]) for place, (name, ends) in enumerate(changing.items())
    }
    _validate(" and ".join(tables), static, dataclasses.replace(params, **apart))


def _check_range(
    place: str, name: str, ends: tuple[float, float], static: StaticParams, params: Params
) -> None:
    if name not in CHANGEABLE:
        raise ValueError(f"{place}: can not change, expected one of {', '.join(CHANGEABLE)}")
    if name == "time_step" and params.trajectories is not None:
        raise ValueError(f"{place}: can not change where truths are recorded")
    if not isinstance(ends, (tuple, list)) or len(ends) != 2:
        raise ValueError(f"{place} = {ends!r}: expected two numbers, from and to")
    for end in ends:
        with_end: dict[str, Any] = {name: end}
        _validate(place, static, dataclasses.replace(params, **with_end))


def _validate(place: str, static: StaticParams, params: Params) -> None:
    try:
        validate(static, params)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None
