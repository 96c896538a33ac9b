"""Free-running episodes: both trackers on the same detections, nothing reset between."""

import dataclasses

import jax
import numpy as np

from jaxtrack.params import Params
from jaxtrack.tracker import TrackerInfo
from jaxtrack.types import NO_DETECTION, Tracks
from reference.parity.rows import Tally
from reference.pipeline import Estimate, StepRecord
from reference.translate import TrackKey, slot_keys

TIE = 1e-12
"""Two competing distances closer than this, relatively, are an exact tie: rounding decides."""


@dataclasses.dataclass(frozen=True)
class Divergence:
    """Where two trackers first differ.

    Attributes:
        step: number of the step, from 1.
        track: birth step and birth detection, None where no single track is concerned.
        quantity: what differs.
        ours: our value.
        theirs: Stone Soup's.
    """

    step: int
    track: TrackKey | None
    quantity: str
    ours: object
    theirs: object

    def __str__(self) -> str:
        """One line that a person can act on."""
        track = "" if self.track is None else f", track born on step {self.track[0]} from {self.track[1]}"
        return f"step {self.step}{track}: {self.quantity} ours {self.ours}, Stone Soup {self.theirs}"


@dataclasses.dataclass
class Comparison:
    """What came out of one episode.

    Attributes:
        steps: steps compared; fewer than there are where an exact tie or a divergence ended it.
        error: largest error, in standard deviations of the quantity.
        birth_error: the same over newborn tracks only.
        updates, births, deletions: how often each happened.
        tie: whether an exact tie ended the comparison.
        divergence: the first difference, None if there is none.
    """

    steps: int = 0
    error: float = 0.0
    birth_error: float = 0.0
    updates: int = 0
    births: int = 0
    deletions: int = 0
    tie: bool = False
    divergence: Divergence | None = None

    @property
    def decisions(self) -> int:
        """Associations, births and deletions that agree."""
        return self.updates + self.births + self.deletions


class EpisodeTallies:
    """What is collected over many episodes against one kind of initiator."""

    def __init__(self) -> None:
        self.steps, self.decisions, self.ties = 0, 0, 0
        self.state, self.birth = Tally(), Tally()
        self.divergences: list[tuple[int, Divergence]] = []

    def add(self, number: int, comparison: Comparison) -> None:
        """Takes one episode; a divergence counts as one decision that disagrees."""
        self.steps += comparison.steps
        self.decisions += comparison.decisions
        self.ties += comparison.tie
        self.state.error(comparison.error)
        self.birth.error(comparison.birth_error)
        if comparison.divergence is not None:
            self.divergences.append((number, comparison.divergence))

    @property
    def agreement(self) -> float:
        """Share of associations, births and deletions that agree, up to first divergences."""
        wrong = len(self.divergences)
        return self.decisions / (self.decisions + wrong) if self.decisions + wrong else float("nan")


def compare_episode(
    records: list[StepRecord],
    tracks: Tracks,
    info: TrackerInfo,
    active: np.ndarray,
    params: Params,
    tolerance: float,
) -> Comparison:
    """Compares every step until the first divergence or exact tie.

    Args:
        records: Stone Soup's steps.
        tracks: `[K, T]` our track lists after every step.
        info: `[K]` our intermediates.
        active: `[K, D]` which rows of the scans hold a detection.
        params: numbers of the tracker.
        tolerance: largest error, in standard deviations, that is no divergence.
    """
    result = Comparison()
    before: list[TrackKey | None] = [None] * tracks.active.shape[1]
    for k, record in enumerate(records):
        now, made = (jax.tree.map(lambda leaf, k=k: leaf[k], tree) for tree in (tracks, info))
        if is_tied(made, active[k], params):
            result.tie = True
            return result
        after = slot_keys(now)
        result.divergence = decision_divergence(record, before, after, made)
        if result.divergence is None:
            result.divergence = compare_estimates(record, after, now, tolerance, result)
        if result.divergence is not None:
            return result
        count_decisions(record, result)
        before = after
    return result


def is_tied(info: TrackerInfo, active: np.ndarray, params: Params) -> bool:
    """Whether two admissible pairs compete for a track or a detection at the same distance."""
    limit = min(float(params.gate_threshold), float(params.missed_distance))
    distances = np.asarray(info.distances, dtype=float)
    exists = np.asarray(info.predicted.active)[:, None] & active
    admissible = np.where(exists & (distances < limit * (1 + TIE)), distances, np.inf)
    return _repeats(admissible) or _repeats(admissible.T)


def _repeats(distances: np.ndarray) -> bool:
    ordered = np.sort(distances, axis=1)
    low, high = ordered[:, :-1], ordered[:, 1:]
    competing = np.isfinite(high)
    return bool(
        np.any(competing & (np.where(competing, high, 0) - np.where(competing, low, 0) <= TIE * high))
    )


def decision_divergence(
    record: StepRecord,
    before: list[TrackKey | None],
    after: list[TrackKey | None],
    info: TrackerInfo,
) -> Divergence | None:
    """The first of association, deletion, birth and track list that differs."""
    associated = {
        key: int(row) for key, row in zip(before, info.associated, strict=True) if key and row != NO_DETECTION
    }
    for key in sorted(associated.keys() | record.associated.keys()):
        ours, theirs = associated.get(key, NO_DETECTION), record.associated.get(key, NO_DETECTION)
        if ours != theirs:
            return Divergence(record.step, key, "associated detection", ours, theirs)
    deleted = {key for key, gone in zip(before, info.deleted, strict=True) if key and gone}
    initiated = {key for key, born in zip(after, info.initiated, strict=True) if key and born}
    live = {key for key in after if key}
    for quantity, mine, stock in (
        ("deleted", deleted, record.deleted),
        ("initiated", initiated, record.initiated),
        ("live", live, set(record.live)),
    ):
        for key in sorted(mine ^ stock):
            return Divergence(record.step, key, quantity, key in mine, key in stock)
    return None


def compare_estimates(
    record: StepRecord, after: list[TrackKey | None], tracks: Tracks, tolerance: float, result: Comparison
) -> Divergence | None:
    """Adds the errors of every live track to the result; the first one beyond the tolerance."""
    for slot, key in enumerate(after):
        if key is None:
            continue
        theirs = record.live[key]
        ours = Estimate(np.asarray(tracks.mean[slot], float), np.asarray(tracks.covariance[slot], float))
        for quantity, errors in estimate_errors(ours, theirs).items():
            if not errors.max() <= tolerance:
                worst = tuple(int(i) for i in np.unravel_index(np.argmax(errors), errors.shape))
                values = getattr(ours, quantity)[worst], getattr(theirs, quantity)[worst]
                what = f"{quantity}{list(worst)} ({errors.max():.1e} sigma apart)"
                return Divergence(record.step, key, what, *map(float, values))
            result.error = max(result.error, float(errors.max()))
            if key in record.initiated:
                result.birth_error = max(result.birth_error, float(errors.max()))
    return None


def estimate_errors(ours: Estimate, theirs: Estimate) -> dict[str, np.ndarray]:
    """Errors of mean `[6]` and covariance `[6, 6]`, in standard deviations."""
    sigma = np.sqrt(np.diag(theirs.covariance))
    return {
        "mean": np.abs(ours.mean - theirs.mean) / sigma,
        "covariance": np.abs(ours.covariance - theirs.covariance) / np.outer(sigma, sigma),
    }


def count_decisions(record: StepRecord, result: Comparison) -> None:
    """Counts what happened on a step that agrees."""
    result.steps += 1
    result.updates += len(record.associated)
    result.births += len(record.initiated)
    result.deletions += len(record.deleted)
