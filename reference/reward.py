"""The rewards of `jaxtrack.reward` in numpy, from Stone Soup's tracks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from jaxtrack.params import Params, StaticParams


@dataclass(frozen=True)
class Uncertainty:
    """What a reward reads of one track: norm and trace of P, and whether a detection is in it now."""

    norm: float
    trace: float
    detected: bool


Snapshot = dict[Track, Uncertainty]
"""The live tracks at one time."""


def snapshot(tracks: Iterable[Track]) -> Snapshot:
    """What the rewards will need of the tracks, which Stone Soup changes in place."""
    return {
        track: Uncertainty(
            norm=float(np.linalg.norm(track.covar)),
            trace=float(np.trace(track.covar)),
            detected=isinstance(track.state, Update),
        )
        for track in tracks
    }


def track_term(before: Snapshot, after: Snapshot, static: StaticParams, params: Params) -> float:
    """The track term of the reward that `static` names.

    Raises:
        ValueError: for a reward that is not rebuilt here.
    """
    if static.reward == "information":
        worth = (max(0.0, 1 - track.trace / params.deletion_threshold) for track in after.values())
        return sum(worth) / static.num_truths
    signs = {"paper": 1.0, "as_printed": -1.0}
    if static.reward not in signs:
        raise ValueError(f"reward = {static.reward!r}: expected information, paper or as_printed")
    fall = sum(
        before[track].norm - now.norm
        for track, now in after.items()
        if track in before and (now.detected or before[track].detected)
    )
    return signs[static.reward] * fall / params.deletion_threshold


def reward_terms(
    before: Snapshot, after: Snapshot, mean_scan_value: float, static: StaticParams, params: Params
) -> tuple[float, float]:
    """Weighted track term and weighted search term (negative); the reward is their sum."""
    track = params.track_weight * track_term(before, after, static, params)
    return track, -params.search_weight * mean_scan_value
