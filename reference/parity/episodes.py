"""Free-running episodes: both trackers on the same detections, nothing reset between."""

import dataclasses

import jax
import numpy as np

from jaxtrack.params import Params, StaticParams
from jaxtrack.tracker import DEFAULT, TrackerInfo
from jaxtrack.types import NO_DETECTION, Tracks
from reference.components import step_duration, transition_model
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
    """What came out of one episode, up to its first divergence, exact tie or covariance without a factor.

    Attributes:
        steps: steps that agree.
        mean_error: largest error of a mean, in its standard deviations.
        covariance_error: largest error of a covariance, in products of standard deviations.
        birth_error: the larger of the two over newborn tracks only.
        updates: associations that agree.
        births: births that agree.
        deletions: deletions that agree.
        tie: whether an exact tie ended the comparison.
        indefinite: whether a covariance ended it from which no sigma points can be made.
        divergence: the first difference, None if there is none.
    """

    steps: int = 0
    mean_error: float = 0.0
    covariance_error: float = 0.0
    birth_error: float = 0.0
    updates: int = 0
    births: int = 0
    deletions: int = 0
    tie: bool = False
    indefinite: bool = False
    divergence: Divergence | None = None

    @property
    def error(self) -> float:
        """The larger error."""
        return max(self.mean_error, self.covariance_error)

    @property
    def decisions(self) -> int:
        """Associations, births and deletions that agree."""
        return self.updates + self.births + self.deletions

    @property
    def agreement(self) -> float:
        """Share of the decisions that agree; a divergence counts as one that does not."""
        return self.decisions / max(self.decisions + (self.divergence is not None), 1)


class EpisodeTallies:
    """What is collected over many episodes against one kind of initiator."""

    def __init__(self) -> None:
        self.steps, self.births, self.decisions, self.ties, self.indefinite = 0, 0, 0, 0, 0
        self.state, self.birth = Tally(), Tally()
        self.divergences: list[tuple[int, Divergence]] = []

    def add(self, number: int, comparison: Comparison) -> None:
        """Takes one episode; a divergence counts as one decision that disagrees."""
        self.steps += comparison.steps
        self.births += comparison.births
        self.decisions += comparison.decisions
        self.ties += comparison.tie
        self.indefinite += comparison.indefinite
        self.state.error(comparison.error)
        self.birth.error(comparison.birth_error)
        if comparison.divergence is not None:
            self.divergences.append((number, comparison.divergence))

    @property
    def agreement(self) -> float:
        """Share of associations, births and deletions that agree, up to first divergences."""
        wrong = len(self.divergences)
        return self.decisions / (self.decisions + wrong) if self.decisions + wrong else float("nan")

    def note(self, *others: str) -> str:
        """What a reader must know of a row: the others, and how many episodes ended for want of a factor."""
        ended = (
            "episodes that end early, with a covariance that is indefinite on both sides (Stone Soup goes on "
            f"with a wrong factor, ours is NaN): {self.indefinite}"
        )
        return "; ".join(filter(None, [*others, ended if self.indefinite else ""]))


def compare_episode(
    records: list[StepRecord],
    tracks: Tracks,
    info: TrackerInfo,
    active: np.ndarray,
    params: Params,
    tolerance: float,
    static: StaticParams = DEFAULT,
) -> Comparison:
    """Compares an episode of ours with Stone Soup's until the first divergence, or until it has no right end.

    Which is at an exact tie, and where sigma points are asked for of a covariance without a Cholesky
    factor. The step that left that covariance is compared, and so is the covariance.

    Args:
        records: Stone Soup's steps.
        tracks: `[K, T]` our track lists after every step.
        info: `[K]` our intermediates.
        active: `[K, D]` which rows of the scans hold a detection.
        params: numbers of the tracker.
        tolerance: largest error, in standard deviations, that is no divergence.
        static: the components, by name.
    """
    without_factor = first_without_factor(records, params) if needs_factors(static) else len(records)
    for k in range(without_factor):
        if is_tied(jax.tree.map(lambda leaf, k=k: leaf[k], info), active[k], params):
            result = compare_records(to_records(tracks, info, k), records[:k], tolerance)
            result.tie = result.divergence is None
            return result
    shared = records[:without_factor]
    result = compare_records(to_records(tracks, info, without_factor), shared, tolerance)
    result.indefinite = len(shared) < len(records) and result.divergence is None
    return result


def needs_factors(static: StaticParams) -> bool:
    """Whether the filter makes sigma points of full covariances."""
    return static.filter in ("unscented", "cubature") and static.covariance_form == "full"


def first_without_factor(records: list[StepRecord], params: Params) -> int:
    """How many steps Stone Soup does before it predicts an indefinite covariance; all of them if it does not.

    Stone Soup's own covariances decide: what is wrong with ours alone is no excuse.
    """
    model, duration = transition_model(params.process_noise), step_duration(params)
    F, Q = model.matrix(time_interval=duration), model.covar(time_interval=duration)
    for k, record in enumerate(records[:-1], start=1):
        try:
            for estimate in record.live.values():
                np.linalg.cholesky(np.asarray(F @ estimate.covariance @ F.T + Q, float))
        except np.linalg.LinAlgError:
            return k
    return len(records)


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
    return bool(np.any(high[competing] - low[competing] <= TIE * high[competing]))


def to_records(tracks: Tracks, info: TrackerInfo, steps: int) -> list[StepRecord]:
    """Our first steps in the form of Stone Soup's, without predictions.

    Args:
        tracks: `[K, T]` track lists after every step.
        info: `[K]` intermediates; `associated`, `updated`, `deleted` and `initiated` are read.
        steps: how many.
    """
    records = []
    for k in range(steps):
        after, updated = (jax.tree.map(lambda leaf, k=k: leaf[k], part) for part in (tracks, info.updated))
        before, now = live_slots(updated), live_slots(after)
        rows = {key: int(info.associated[k, slot]) for key, slot in before.items()}
        records.append(
            StepRecord(
                step=k + 1,
                expected={},
                associated={key: row for key, row in rows.items() if row != NO_DETECTION},
                updated=estimates(updated, before),
                deleted={key for key, slot in before.items() if info.deleted[k, slot]},
                initiated={key for key, slot in now.items() if info.initiated[k, slot]},
                live=estimates(after, now),
            )
        )
    return records


def live_slots(tracks: Tracks) -> dict[TrackKey, int]:
    """The slot of every live track."""
    return {key: slot for slot, key in enumerate(slot_keys(tracks)) if key}


def estimates(tracks: Tracks, slots: dict[TrackKey, int]) -> dict[TrackKey, Estimate]:
    """Estimates of tracks by their slots."""
    mean, covariance = np.asarray(tracks.mean, float), np.asarray(tracks.covariance, float)
    return {key: Estimate(mean[slot], covariance[slot]) for key, slot in slots.items()}


def compare_records(ours: list[StepRecord], theirs: list[StepRecord], tolerance: float) -> Comparison:
    """Compares every decision and estimate of every step until the first divergence.

    Args:
        ours: our steps.
        theirs: Stone Soup's, of the same scans.
        tolerance: largest error, in standard deviations, that is no divergence.
    """
    result = Comparison()
    for our, their in zip(ours, theirs, strict=True):
        result.divergence = decision_divergence(our, their)
        if result.divergence is None:
            result.divergence = compare_estimates(our, their, tolerance, result)
        if result.divergence is not None:
            return result
        result.steps += 1
        result.updates += len(their.associated)
        result.births += len(their.initiated)
        result.deletions += len(their.deleted)
    return result


def decision_divergence(our: StepRecord, their: StepRecord) -> Divergence | None:
    """The first of association, deletion, birth and track list that differs."""
    for key in sorted(our.associated.keys() | their.associated.keys()):
        rows = our.associated.get(key, NO_DETECTION), their.associated.get(key, NO_DETECTION)
        if rows[0] != rows[1]:
            return Divergence(their.step, key, "associated detection", *rows)
    for quantity in ("deleted", "initiated", "live"):
        mine, stock = set(getattr(our, quantity)), set(getattr(their, quantity))
        for key in sorted(mine ^ stock):
            return Divergence(their.step, key, quantity, key in mine, key in stock)
    return None


def compare_estimates(
    our: StepRecord, their: StepRecord, tolerance: float, result: Comparison
) -> Divergence | None:
    """Adds the errors of every live track to the result; the first entry beyond the tolerance."""
    for key, stock in their.live.items():
        ours = our.live[key]
        for quantity, errors in estimate_errors(ours, stock).items():
            largest = float(errors.max())
            if not largest <= tolerance:
                worst = tuple(int(i) for i in np.unravel_index(np.argmax(errors), errors.shape))
                values = getattr(ours, quantity)[worst], getattr(stock, quantity)[worst]
                what = f"{quantity}{list(worst)} ({largest:.1e} sigma apart)"
                return Divergence(their.step, key, what, *map(float, values))
            name = f"{quantity}_error"
            setattr(result, name, max(getattr(result, name), largest))
            if key in their.initiated:
                result.birth_error = max(result.birth_error, largest)
    return None


def estimate_errors(ours: Estimate, theirs: Estimate) -> dict[str, np.ndarray]:
    """Errors of mean `[6]` and covariance `[6, 6]`, in standard deviations."""
    sigma = np.sqrt(np.diag(theirs.covariance))
    return {
        "mean": np.abs(ours.mean - theirs.mean) / sigma,
        "covariance": np.abs(ours.covariance - theirs.covariance) / np.outer(sigma, sigma),
    }
