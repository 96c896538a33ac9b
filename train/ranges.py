"""Tables of numbers that change during a training, by name from one value to another: what may stand in them.

`curriculum` and `randomise` of a training's configuration are such tables; `train/varied.py` uses them.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, get_args

import numpy as np
from tyro.constructors import PrimitiveConstructorSpec

from jaxtrack.params import Params, StaticParams, validate

FIXED = ("field_limit", "beam_azimuth", "beam_elevation", "max_steps_in_episode", "trajectories")
"""Numbers that say what an action or an episode is; they stay as they are during a training."""
CHANGEABLE = tuple(sorted(field.name for field in dataclasses.fields(Params) if field.name not in FIXED))
COUNTS = tuple(
    field.name for field in dataclasses.fields(Params) if int in (get_args(field.type) or [field.type])
)
"""Numbers that are whole."""


def parse_ranges(words: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Ranges from words such as `clutter_rate=0:0.2`.

    Raises:
        ValueError: naming the word that is none.
    """
    ranges = {}
    for word in words:
        name, _, ends = word.partition("=")
        try:
            low, high = (_number(end) for end in ends.split(":"))
        except ValueError:
            raise ValueError(f"{word!r}: expected NAME=FROM:TO, such as clutter_rate=0:0.2") from None
        ranges[name.replace("-", "_")] = (low, high)
    return ranges


def _number(text: str) -> float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def _is_ranges(value: Any) -> bool:
    return isinstance(value, dict)


def _words(ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    return [f"{name}={low}:{high}" for name, (low, high) in ranges.items()]


Ranges = Annotated[
    dict[str, tuple[float, float]],
    PrimitiveConstructorSpec("*", "NAME=FROM:TO", parse_ranges, _is_ranges, _words),
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
