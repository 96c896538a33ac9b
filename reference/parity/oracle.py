"""Stock Stone Soup on many scenarios: one process per core, results as plain arrays."""

import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxtrack.params import StaticParams
from jaxtrack.tracker import DEFAULT
from jaxtrack.types import NO_DETECTION, STATE_DIM, Tracks
from reference.parity.scenarios import Scenario
from reference.pipeline import StepRecord, StoneSoupTracker


@dataclass(frozen=True)
class Job:
    """What a process is asked to do; see `StoneSoupTracker` for all but the first."""

    scenario: Scenario
    exact_jacobian: bool = True
    intermediates: bool = False
    static: StaticParams = DEFAULT


def run(job: Job) -> list[StepRecord]:
    """One free-running episode of the stock tracker."""
    oracle = StoneSoupTracker(job.scenario.params, job.exact_jacobian, job.intermediates, job.static)
    detections = job.scenario.detections
    return [
        oracle.step(value, active) for value, active in zip(detections.value, detections.active, strict=True)
    ]


def run_all(jobs: Iterable[Job], processes: int) -> Iterator[list[StepRecord]]:
    """Results in the order of the jobs, as they become ready; with one process, in this one."""
    if processes < 2:
        yield from map(run, jobs)
        return
    # Not forked: JAX has threads, which do not survive a fork.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(run, jobs)


def tracks_before(records: list[StepRecord], max_tracks: int) -> Tracks:
    """The oracle's track list before every step, `[K, T]` in float64, in the order of the keys.

    Raises:
        ValueError: if there are more tracks than slots.
    """
    steps = len(records)
    mean: Any = np.zeros((steps, max_tracks, STATE_DIM))
    covariance: Any = np.zeros((steps, max_tracks, STATE_DIM, STATE_DIM))
    births: Any = np.full((steps, max_tracks, 2), NO_DETECTION)
    active: Any = np.zeros((steps, max_tracks), dtype=bool)
    for step, record in enumerate(records[:-1], start=1):
        if len(record.live) > max_tracks:
            raise ValueError(f"{len(record.live)} tracks: expected at most max_tracks = {max_tracks}")
        for slot, key in enumerate(sorted(record.live)):
            estimate = record.live[key]
            mean[step, slot], covariance[step, slot] = estimate.mean, estimate.covariance
            births[step, slot], active[step, slot] = key, True
    age: Any = np.where(active, np.arange(steps)[:, None] - births[..., 0], 0)
    return Tracks(
        mean=mean,
        covariance=covariance,
        active=active,
        updated_by=np.full_like(births[..., 0], NO_DETECTION),
        birth_step=births[..., 0],
        birth_detection=births[..., 1],
        age=age,
    )
