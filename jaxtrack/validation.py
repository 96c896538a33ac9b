"""Checks of `Params` on the host, before anything is traced, and their ranges in words."""

import dataclasses
from typing import Any

import numpy as np

from jaxtrack.params import LARGEST, Params, StaticParams


def validate(static: StaticParams, params: Params) -> None:
    """Checks every number against its range; call it on the host, once.

    Raises:
        ValueError: naming the field, its value, and the range allowed.
    """
    for field in dataclasses.fields(params):
        if field.metadata and "low" in field.metadata:
            value = getattr(params, field.name)
            if value is not None or field.default is not None:
                _check_quantity(field, value)
    if np.any(np.asarray(params.min_range) > np.asarray(params.max_range)):
        raise ValueError(f"min_range = {params.min_range}: expected at most max_range = {params.max_range} m")
    if np.any(np.asarray(params.clutter_rate) > static.max_clutter):
        raise ValueError(
            f"clutter_rate = {params.clutter_rate}: expected at most max_clutter = "
            f"{static.max_clutter} 1/look"
        )
    _check_deleters(static, params)
    _check_stop(static, params)
    _check_initial_truths(static, params)
    check_trajectories(static, params)
    _check_recording(params)


def check_trajectories(static: StaticParams, params: Params) -> None:
    """Raises ValueError when replayed trajectories do not fit the number of truths."""
    if params.trajectories is not None:
        shape = np.shape(params.trajectories)[-3:]
        if len(shape) != 3 or shape[0] < 1 or shape[1:] != (static.num_truths, 6):
            raise ValueError(
                f"trajectories has shape {np.shape(params.trajectories)}: expected "
                f"[times, num_truths = {static.num_truths}, 6]"
            )


def _check_recording(params: Params) -> None:
    if params.trajectories is None:
        return
    recorded = np.asarray(params.trajectories)
    if recorded.dtype.kind not in "iuf" or np.any(np.abs(recorded) > LARGEST):
        raise ValueError(
            f"trajectories: expected numbers in [{-LARGEST:g}, {LARGEST:g}] (m, m/s), or NaN where absent"
        )


def _check_deleters(static: StaticParams, params: Params) -> None:
    for deleter, name in (("update_time", "deletion_time"), ("update_time_steps", "deletion_steps")):
        if deleter in static.deleters and getattr(params, name) is None:
            raise ValueError(f"{name} = None: expected a number for deleters = {static.deleters!r}")


def _check_stop(static: StaticParams, params: Params) -> None:
    if static.stop_metric is None and params.stop_threshold is None:
        return
    threshold = _numbers(params.stop_threshold)
    if threshold is None or not np.all(np.isfinite(threshold)):
        raise ValueError(
            f"stop_threshold = {params.stop_threshold!r}: expected a number for "
            f"stop_metric = {static.stop_metric!r}"
        )


def _check_initial_truths(static: StaticParams, params: Params) -> None:
    if params.initial_truths is None:
        return
    first = _numbers(params.initial_truths)
    if first is None or first.dtype.kind == "f" or np.any(first < 0) or np.any(first > static.num_truths):
        raise ValueError(
            f"initial_truths = {params.initial_truths!r}: expected an integer in [0, {static.num_truths}]"
        )


def allowed_range(field: dataclasses.Field) -> str:
    """Range of a number of `Params` in words, such as (0, 1]: a square bracket includes the end."""
    low, high = field.metadata["low"], field.metadata["high"]
    return f"{'(' if field.metadata['open_low'] else '['}{low:g}, {high:g}]"


def with_unit(text: str, field: dataclasses.Field) -> str:
    """The text with the unit of a number of `Params` after it; as it is where the unit is 1."""
    unit = field.metadata["unit"]
    return text if unit == "1" else f"{text} {unit}"


def _check_quantity(field: dataclasses.Field, value: Any) -> None:
    low, high = field.metadata["low"], field.metadata["high"]
    is_count = field.metadata["unit"] == "steps"
    kind = "a whole number" if is_count else "a number"
    expected = f"expected {kind} in {with_unit(allowed_range(field), field)}"
    numbers = _numbers(value)
    if numbers is None:
        raise ValueError(f"{field.name} = {value!r}: {expected}")
    inside = numbers > low if field.metadata["open_low"] else numbers >= low
    inside &= numbers <= high
    if is_count:
        inside &= numbers == np.round(numbers)
    if not np.all(inside):
        raise ValueError(f"{field.name} = {value}: {expected}")


def _numbers(value: Any) -> np.ndarray | None:
    """The number, or the array of numbers; nothing for text, True, a list, or an array without any."""
    if isinstance(value, (list, tuple)):  # JAX would take it for a tree
        return None
    numbers = np.asarray(value)
    return numbers if numbers.dtype.kind in "iuf" and numbers.size else None
