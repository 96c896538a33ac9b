"""jaxtrack's tracker and stock Stone Soup on the same recorded detections, compared scan by scan."""

import dataclasses
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, NO_TRUTH, Detections
from reference.parity.episodes import to_records
from reference.parity.ours import track_detections
from reference.pipeline import StepRecord, StoneSoupTracker
from reference.translate import TrackKey


@dataclasses.dataclass(frozen=True)
class Run:
    """What one tracker made of the detections.

    Attributes:
        records: decisions and estimates of every scan.
        seconds: time it took, without compilation.
        compile_seconds: time of compilation; 0 for Stone Soup.
    """

    records: list[StepRecord]
    seconds: float
    compile_seconds: float = 0.0


def run_jaxtrack(detections: Detections, params: Params) -> Run:
    """Our tracker on detections `[K, D]`; track slots are doubled until nothing is dropped."""
    slots = detections.active.shape[1]
    while True:
        slots *= 2
        started = time.perf_counter()
        played = track_detections.lower(detections, params, slots).compile()
        compiled = time.perf_counter()
        after, info = jax.device_get(jax.block_until_ready(played(detections, params)))
        seconds = time.perf_counter() - compiled
        if not info.num_dropped.any():
            return Run(to_records(after, info, len(info.num_dropped)), seconds, compiled - started)


def run_stone_soup(detections: Detections, params: Params, exact_jacobian: bool, progress: bool) -> Run:
    """Stock Stone Soup on detections `[K, D]`."""
    from rich.console import Console
    from rich.progress import track

    words = f"Stone Soup, {'exact' if exact_jacobian else 'stock'} Jacobian"
    scans: Iterable[Any] = zip(detections.value, detections.active, strict=True)
    scans = track(scans, words, len(detections.value), console=Console(stderr=True), disable=not progress)
    oracle = StoneSoupTracker(params, exact_jacobian, intermediates=False)
    started = time.perf_counter()
    records = [oracle.step(value, active) for value, active in scans]
    return Run(records, time.perf_counter() - started)


@dataclasses.dataclass(frozen=True)
class Quality:
    """How good the tracks of a run are.

    Attributes:
        tracks: tracks born.
        updated_tracks: those of them that got a second detection.
        aircraft: aircraft detected at least once.
        purity: share of the tracks' detections that come from the track's main aircraft.
        position_rmse: root mean square distance (m) of a track from its main aircraft, over
            the scans in which it got a detection.
    """

    tracks: int
    updated_tracks: int
    aircraft: int
    purity: float
    position_rmse: float


def judge(records: list[StepRecord], detections: Detections, states: np.ndarray) -> Quality:
    """Judges the tracks by the aircraft `states` `[K, N, 6]` behind the detections `[K, D]`."""
    sources = sources_of(records, detections)
    main = main_aircraft(sources)
    pure = sum(truth == main[key] for key, seen in sources.items() for _, truth in seen if truth != NO_TRUTH)
    squares = [
        np.sum((records[k].live[key].mean - states[k, main[key]])[0::2] ** 2)
        for key, seen in sources.items()
        for k, _ in seen
        if main[key] != NO_TRUTH
    ]
    return Quality(
        tracks=len(sources),
        updated_tracks=sum(len(seen) > 1 for seen in sources.values()),
        aircraft=len(np.setdiff1d(detections.truth, [NO_TRUTH])),
        purity=pure / max(sum(map(len, sources.values())), 1),
        position_rmse=float(np.sqrt(np.nanmean(squares))) if squares else float("nan"),
    )


def sources_of(records: list[StepRecord], detections: Detections) -> dict[TrackKey, list[tuple[int, int]]]:
    """For every track the scans in which it got a detection, and the aircraft behind each."""
    sources = defaultdict(list)
    for k, record in enumerate(records):
        for key in record.live:
            if (row := record.source(key)) != NO_DETECTION:
                sources[key].append((k, int(detections.truth[k, row])))
    return dict(sources)


def main_aircraft(sources: dict[TrackKey, list[tuple[int, int]]]) -> dict[TrackKey, int]:
    """The aircraft behind most detections of each track; `NO_TRUTH` where all are false."""
    counts = {key: Counter(t for _, t in seen if t != NO_TRUTH) for key, seen in sources.items()}
    return {key: count.most_common(1)[0][0] if count else NO_TRUTH for key, count in counts.items()}
