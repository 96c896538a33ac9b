"""The rewards of `jaxtrack.reward` in numpy, from Stone Soup's tracks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from jaxtrack.observation import CONFIRMED_SHARE
from jaxtrack.params import Params, StaticParams
from jaxtrack.reward import LOST_STEPS


@dataclass(frozen=True)
class Uncertainty:
    """What a reward reads of one track: norm of P, its trace and velocity's part, whether it is detected."""

    norm: float
    trace: float
    velocity_trace: float
    detected: bool


Snapshot = dict[Track, Uncertainty]
"""The live tracks at one time."""


def snapshot(tracks: Iterable[Track]) -> Snapshot:
    """What the rewards will need of the tracks, which Stone Soup changes in place."""
    return {
        track: Uncertainty(
            norm=float(np.linalg.norm(track.covar)),
            trace=float(np.trace(track.covar)),
            velocity_trace=float(np.diag(track.covar)[1::2].sum()),
            detected=isinstance(track.state, Update),
        )
        for track in tracks
    }


def search_term(after: Snapshot, scan_map: np.ndarray, static: StaticParams, params: Params) -> float:
    """The search term: minus the mean of a power of the scan values, or 0 if there is nothing left to find.

    Args:
        after: the tracks after the step.
        scan_map: `[M, M]` after it.
        static: shapes and choices.
        params: numbers.
    """
    new = 3 * params.prior_velocity_sigma**2
    confirmed = sum(track.velocity_trace < CONFIRMED_SHARE * new for track in after.values())
    if static.search_until_complete and confirmed >= static.num_truths:
        return 0.0
    return -float((scan_map**static.search_sharpness).mean())


def track_term(
    before: Snapshot, after: Snapshot, gospa: float, num_living: int, static: StaticParams, params: Params
) -> float:
    """The track term of the reward that `static` names.

    Args:
        before: the tracks before the step.
        after: the tracks after it.
        gospa: GOSPA distance after it (m), which only the reward of that name reads.
        num_living: truths alive.
        static: shapes.
        params: numbers.
    """
    if static.reward == "gospa":
        worst = params.gospa_cutoff * (max(num_living, 1) / 2) ** (1 / params.gospa_order)
        return 1 - gospa / worst
    if static.reward == "information":
        worth = (max(0.0, 1 - track.trace / params.deletion_threshold) for track in after.values())
        return sum(worth) / static.num_truths
    if static.reward == "shortfall":
        cost = sum(min(1.0, track.trace / params.deletion_threshold) for track in after.values())
        return -(cost + LOST_STEPS * len(before.keys() - after.keys())) / static.num_truths
    signs = {"paper": 1.0, "as_printed": -1.0}
    fall = sum(
        before[track].norm - now.norm
        for track, now in after.items()
        if track in before and (now.detected or before[track].detected)
    )
    return signs[static.reward] * fall / params.deletion_threshold
