"""Records of truths and tracks over time: the material of the metrics' parity."""

import dataclasses
from typing import Any

import numpy as np

from jaxtrack.params import Params
from jaxtrack.types import NEVER, NO_DETECTION, NO_TRUTH, Tracks, Truths
from reference.parity.scenes import random_covariances

SWITCH, GLITCH, SPURIOUS = 0.05, 0.15, 0.2
"""Chances, per step, that a track turns to another truth for good or for this step only, and
that what it turns to is no truth at all."""

CENTRE = (3000.0, 800.0, 500.0)
"""Place around which the truths start (m)."""


@dataclasses.dataclass(frozen=True)
class Record:
    """Truths and tracks of K steps, in float64 on the host; step k is at time k * time_step.

    Attributes:
        params: numbers of the scenario and of the metrics.
        truths: `[K, N, ...]`; a row is one truth.
        tracks: `[K, T, ...]`; a slot may hold one track after another.
    """

    params: Params
    truths: Truths
    tracks: Tracks


def random_record(
    rng: np.random.Generator,
    params: Params,
    num_steps: int = 60,
    num_truths: int = 6,
    max_tracks: int = 10,
) -> Record:
    """A record in which everything happens that metrics over time must get right.

    Truths appear and vanish, one may never live, and several lie within reach of each other.
    Tracks begin and end, one after another in a slot, follow a truth, pass to another one, miss
    a step, or belong to none; on two steps there is no track at all. Empty rows hold NaN.
    """
    path = _random_paths(rng, params, num_steps, num_truths)
    alive = _random_lives(rng, num_steps, num_truths)
    births, target = _random_tracks(rng, num_steps, num_truths, max_tracks)
    active = births != NEVER
    steps, slots = np.arange(num_steps)[:, None], np.arange(max_tracks)
    around = path[steps, np.maximum(target, 0)]
    nowhere = np.where(target[..., None] == NO_TRUTH, rng.uniform(3000.0, 4000.0, (max_tracks, 6)), 0.0)
    noise = 30.0 * rng.standard_normal((max_tracks, 6)) + 10.0 * rng.standard_normal(around.shape)
    covariance = random_covariances(rng, num_steps * max_tracks).reshape(num_steps, max_tracks, 6, 6)
    truths: dict[str, Any] = {"state": np.where(alive[..., None], path, np.nan), "alive": alive}
    tracks: dict[str, Any] = {
        "mean": np.where(active[..., None], around + noise + nowhere, np.nan),
        "covariance": np.where(active[..., None, None], covariance, np.nan),
        "active": active,
        "updated_by": np.full(active.shape, NO_DETECTION),
        "birth_step": births,
        "birth_detection": np.where(active, slots, NO_DETECTION),
        "age": np.where(active, steps - births, 0),
    }
    return Record(params, Truths(**truths), Tracks(**tracks))


def _random_paths(rng: np.random.Generator, params: Params, num_steps: int, num_truths: int) -> np.ndarray:
    """Straight paths `[K, N, 6]`, lived or not, mostly within reach of each other."""
    start = np.zeros((num_truths, 6))
    start[:, 0::2] = CENTRE + 0.8 * params.siap_threshold * rng.standard_normal((num_truths, 3))
    start[:, 1::2] = params.truth_velocity_sigma * rng.standard_normal((num_truths, 3))
    path = np.tile(start, (num_steps, 1, 1))
    path[..., 0::2] += params.time_step * np.arange(num_steps)[:, None, None] * start[:, 1::2]
    return path


def _random_lives(rng: np.random.Generator, num_steps: int, num_truths: int) -> np.ndarray:
    """`[K, N]` when the truths live: about half of them from the start, about half to the end."""
    third = num_steps // 3
    first = rng.integers(0, third, num_truths) * rng.integers(0, 2, num_truths)
    last = num_steps - rng.integers(0, third, num_truths) * rng.integers(0, 2, num_truths)
    last[-1] *= rng.integers(0, 2)  # at times there is no such truth
    steps = np.arange(num_steps)[:, None]
    return (first <= steps) & (steps < last)


def _random_tracks(
    rng: np.random.Generator, num_steps: int, num_truths: int, max_tracks: int
) -> tuple[np.ndarray, np.ndarray]:
    """Birth step `[K, T]` of the track in every slot, `NEVER` where there is none, and what it is near."""
    births = np.full((num_steps, max_tracks), NEVER)
    target = np.full((num_steps, max_tracks), NO_TRUTH)
    pause = int(rng.integers(num_steps // 2, num_steps))  # for two steps nobody tracks anything
    for slot in range(max_tracks):
        for first, end in ((0, pause), (pause + 2, num_steps)):
            birth = first + int(rng.integers(0, 8))
            while birth < end:
                life = min(int(rng.integers(1, num_steps)), end - birth)
                births[birth : birth + life, slot] = birth
                target[birth : birth + life, slot] = _random_targets(rng, life, num_truths)
                birth += life + int(rng.integers(0, 6))  # 0: deleted and replaced in one step
    return births, target


def _random_targets(rng: np.random.Generator, life: int, num_truths: int) -> np.ndarray:
    """Truth `[life]` that a track is near on every step, or `NO_TRUTH`."""

    def anything(count: int) -> np.ndarray:
        return np.where(rng.random(count) < SPURIOUS, NO_TRUTH, rng.integers(0, num_truths, count))

    turns = np.cumsum(rng.random(life) < SWITCH)
    lasting, rival = anything(life + 1), anything(life + 1)
    glitch = rng.random(life) < GLITCH
    # A track that errs tends to err towards the same rival.
    return np.where(glitch, rival[turns], lasting[turns])


def random_records(seed: int, count: int) -> list[Record]:
    """Records of one shape, so that everything is compiled once, with random numbers of the metrics."""
    records = []
    for rng in np.random.default_rng(seed).spawn(count):
        # Whole metres: with others Stone Soup's two ways to compute c^p may differ in the last bit,
        # and it then counts pairs at the cut-off as localised instead of missed and false.
        reach = float(rng.integers(50, 400))
        params = Params(
            time_step=int(rng.integers(5, 500)) / 1000,
            gospa_cutoff=reach,
            gospa_order=float(rng.choice([1.0, 2.0, 3.0])),
            siap_threshold=rng.uniform(50, 400),
        )
        records.append(random_record(rng, params))
    return records
