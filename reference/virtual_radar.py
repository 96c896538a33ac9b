"""An all-round radar that does not exist, looking at aircraft that do: detections of a recording."""

import csv
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack.detection_file import COLUMNS
from jaxtrack.models import elevation_bearing_range, wrap_detection
from jaxtrack.params import Params
from jaxtrack.trajectories import Recording
from jaxtrack.types import NO_TRUTH, Detections
from reference.components import noise_sigmas


def scan_interval(recording: Recording) -> float:
    """Time between scans (s).

    Raises:
        ValueError: if scans are not evenly spaced, naming the first that is not.
    """
    gaps = np.diff(recording.times)
    uneven = np.flatnonzero(gaps != gaps[:1])
    if len(gaps) == 0 or len(uneven):
        where = f"{gaps[uneven[0]]} s before scan {uneven[0] + 2}" if len(uneven) else "one scan only"
        raise ValueError(f"{where}: expected at least two scans, evenly spaced in time")
    return float(gaps[0])


def observe_aircraft(
    recording: Recording, scans: int, params: Params, clutter: float, seed: int
) -> Detections:
    """What the virtual radar reports `[K, D]`: an all-round look at every aircraft in each scan.

    Aircraft come first, in the order of `recording.ids`, then clutter.
    """
    rng = np.random.default_rng(seed)
    states = recording.states[:scans]
    truth = np.asarray(elevation_bearing_range(jnp.asarray(states)))
    noise = noise_sigmas(params) * rng.standard_normal(truth.shape)
    value = np.asarray(wrap_detection(jnp.asarray(truth + noise)))
    present = np.isfinite(states).all(axis=-1)
    present &= rng.random(present.shape) < params.detection_probability
    low, high = np.nanmin(truth, axis=(0, 1)), np.nanmax(truth, axis=(0, 1))
    rows = []
    for k in range(scans):
        seen = np.flatnonzero(present[k])
        false = rng.uniform(low, high, (rng.poisson(clutter), 3))
        rows.append((np.concatenate([value[k, seen], false]), np.append(seen, np.full(len(false), NO_TRUTH))))
    capacity = max(1, max(len(source) for _, source in rows))
    record = (
        np.zeros((scans, capacity, 3)),
        np.zeros((scans, capacity), bool),
        np.full((scans, capacity), NO_TRUTH),
    )
    for k, (values, source) in enumerate(rows):
        for array, numbers in zip(record, (values, True, source), strict=True):
            array[k, : len(source)] = numbers
    return jax.tree.map(np.asarray, Detections(*map(jnp.asarray, record)))


def write_detections(path: Path, detections: Detections, time_step: float) -> None:
    """Writes detections `[K, D]`: s, rad, rad, m; an empty scan is a row with only its time."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for k, (value, active) in enumerate(zip(detections.value, detections.active, strict=True)):
            rows = value[active].tolist() or [[""] * 3]
            writer.writerows([k * time_step, *row] for row in rows)
