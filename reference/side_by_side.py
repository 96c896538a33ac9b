"""jaxtrack's tracker and stock Stone Soup on the same recorded detections, compared scan by scan."""

import dataclasses
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import tracker
from jaxtrack.params import Params
from jaxtrack.types import NO_DETECTION, NO_TRUTH, Detections, Tracks
from reference.parity.compare import covariance_error, mean_error
from reference.pipeline import Estimate, StepRecord, StoneSoupTracker
from reference.translate import TrackKey, slot_keys

STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz")


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


@dataclasses.dataclass(frozen=True)
class Comparison:
    """How equal two runs are.

    Attributes:
        decisions: births, associations and deletions compared.
        different: how many of them differ.
        estimates: means and covariances compared.
        mean_error: largest error of a mean (standard deviations).
        covariance_error: largest error of a covariance (of the product of standard deviations).
        first: the first difference, in words; empty without one.
    """

    decisions: int
    different: int
    estimates: int
    mean_error: float
    covariance_error: float
    first: str

    @property
    def agreement(self) -> float:
        """Share of the decisions that are the same."""
        return 1 - self.different / max(self.decisions, 1)


def run_jaxtrack(detections: Detections, params: Params) -> Run:
    """Our tracker on detections `[K, D]`; track slots are doubled until nothing is dropped."""

    @jax.jit
    def play(detections: Detections, tracks: Tracks) -> Any:
        def one_scan(carry: tuple[Tracks, jax.Array], now: Detections) -> Any:
            tracks, info = tracker.step(carry[0], now, params.time_step, carry[1], params)
            kept = (info.associated, info.updated, info.deleted, info.initiated, info.num_dropped)
            return (tracks, carry[1] + 1), (tracks, *kept)

        return jax.lax.scan(one_scan, (tracks, jnp.asarray(1)), detections)[1]

    slots = detections.active.shape[1]
    while True:
        slots *= 2
        started = time.perf_counter()
        played = play.lower(detections, Tracks.empty(slots)).compile()
        compiled = time.perf_counter()
        made = jax.device_get(jax.block_until_ready(played(detections, Tracks.empty(slots))))
        seconds = time.perf_counter() - compiled
        if not made[-1].any():
            return Run(to_records(*made[:-1]), seconds, compiled - started)


def to_records(
    after: Tracks, associated: np.ndarray, updated: Tracks, deleted: np.ndarray, initiated: np.ndarray
) -> list[StepRecord]:
    """Our results `[K, T]` as Stone Soup's are recorded, so that one comparison serves both."""
    records = []
    for k in range(len(deleted)):
        now, moved = (jax.tree.map(lambda leaf, k=k: leaf[k], tracks) for tracks in (after, updated))
        before, keys = live_slots(moved), live_slots(now)
        rows = {key: int(associated[k, slot]) for key, slot in before.items()}
        records.append(
            StepRecord(
                step=k + 1,
                expected={},
                associated={key: row for key, row in rows.items() if row != NO_DETECTION},
                updated=estimates(moved, before),
                deleted={key for key, slot in before.items() if deleted[k, slot]},
                initiated={key for key, slot in keys.items() if initiated[k, slot]},
                live=estimates(now, keys),
            )
        )
    return records


def live_slots(tracks: Tracks) -> dict[TrackKey, int]:
    """The slot of every live track."""
    return {key: slot for slot, key in enumerate(slot_keys(tracks)) if key}


def estimates(tracks: Tracks, slots: dict[TrackKey, int]) -> dict[TrackKey, Estimate]:
    """Estimates of tracks by their slots."""
    mean, covariance = np.asarray(tracks.mean), np.asarray(tracks.covariance)
    return {key: Estimate(mean[slot], covariance[slot]) for key, slot in slots.items()}


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


def compare(ours: list[StepRecord], theirs: list[StepRecord], tolerance: float) -> Comparison:
    """Compares every birth, association, deletion and estimate of every scan.

    Args:
        ours: records of jaxtrack.
        theirs: records of Stone Soup, of the same scans.
        tolerance: an estimate that is further off than this (standard deviations) is a
            difference worth naming; infinite where only decisions count.
    """
    decisions = different = compared = 0
    largest_mean = largest_covariance = 0.0
    first = ""
    for our, their in zip(ours, theirs, strict=True):
        for words, ours_says, theirs_says in _decisions(our, their):
            decisions += 1
            if ours_says != theirs_says:
                different += 1
                first = first or f"{words}: {ours_says} in jaxtrack, {theirs_says} in Stone Soup"
        for key in sorted(our.live.keys() & their.live.keys()):
            compared += 1
            a, b = our.live[key], their.live[key]
            errors = mean_error(a.mean, b.mean, b.covariance), covariance_error(a.covariance, b.covariance)
            largest_mean = float(np.maximum(largest_mean, errors[0]))  # keeps NaN
            largest_covariance = float(np.maximum(largest_covariance, errors[1]))
            if not (errors[0] <= tolerance and errors[1] <= tolerance):
                first = first or _worst_entry(our.step, key, a, b, errors)
    return Comparison(decisions, different, compared, largest_mean, largest_covariance, first)


def _decisions(our: StepRecord, their: StepRecord) -> Iterator[tuple[str, Any, Any]]:
    """Every decision of one scan: what it is about, and what both sides say."""
    for key in sorted(our.updated.keys() | their.updated.keys()):
        about = f"scan {our.step}, track {key}"
        yield (
            f"{about}, associated detection",
            our.associated.get(key, NO_DETECTION),
            their.associated.get(key, NO_DETECTION),
        )
        yield f"{about}, deleted", key in our.deleted, key in their.deleted
    for key in sorted(our.initiated | their.initiated):
        yield f"scan {our.step}, track {key}, born", key in our.initiated, key in their.initiated


def _worst_entry(step: int, key: TrackKey, a: Estimate, b: Estimate, errors: tuple[float, float]) -> str:
    """In words: the entry of one track's estimate that is furthest off in standard deviations."""
    sigma = np.sqrt(np.diag(b.covariance))
    if np.argmax(errors) == 0:  # the first NaN, where there is one
        i = int(np.argmax(np.abs(a.mean - b.mean) / sigma))
        entry, ours, theirs = f"mean of {STATE_NAMES[i]}", a.mean[i], b.mean[i]
    else:
        off = np.abs(a.covariance - b.covariance) / np.outer(sigma, sigma)
        i, j = divmod(int(np.argmax(off)), len(sigma))
        entry = f"covariance of {STATE_NAMES[i]} and {STATE_NAMES[j]}"
        ours, theirs = a.covariance[i, j], b.covariance[i, j]
    return (
        f"scan {step}, track {key}, {entry}: {float(ours)!r} in jaxtrack, {float(theirs)!r} in Stone Soup "
        f"({np.max(errors):.1e} standard deviations apart)"
    )


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
