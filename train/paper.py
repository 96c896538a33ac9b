"""What the paper reports, and what it leaves open: data of other people, and our choices beside it."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxtrack.params import Params, StaticParams


class PaperRow(NamedTuple):
    """A row of the paper's table of results.

    Attributes:
        name: as printed.
        ours: our name of that policy.
        t2t: its "Mean T2T".
        norm: its mean covariance norm.
        norm_as_printed: the same with what is printed after the sign.
    """

    name: str
    ours: str
    t2t: float
    norm: float
    norm_as_printed: str


SOURCE = (
    "J.-H. Ewers, J. Gibbs and D. Anderson, *Stone Soup Multi-Target Tracking Feature Extraction For "
    "Autonomous Search And Track In Deep Reinforcement Learning Environment*, "
    "[arXiv:2503.01293](https://arxiv.org/abs/2503.01293), "
    'table "Track Metrics for each agent and baseline search policy"'
)
PAPER = (
    PaperRow("Coverage", "coverage", 0.942, 574.27, "574.27 ± 424.53"),
    PaperRow("Random", "random", 1.585, 948.15, "948.15 ± 921.87"),
    PaperRow("Static", "static", 0.288, 2630.72, "2630.72 ± 2358.40"),
    PaperRow("PPO-Flatten", "flatten", 1.407, 790.63, "790.63 ± 852.00"),
    PaperRow("PPO-BiGRU", "bigru", 1.430, 730.56, "730.56.27 ± 744.81 (sic)"),
    PaperRow("PPO-BiGRU-MHSA", "mhsa", 1.152, 461.98, "461.98 ± 573.50"),
)
"""The authors' results, typed off their table; `SOURCE` says where it stands."""


def open_places(static: StaticParams, params: Params) -> Sequence[Sequence[str]]:
    """What the paper does not say, or not clearly, and our choice, with the numbers that were played."""
    kilometres = f"{params.min_range / 1000:g} to {params.max_range / 1000:g} km"
    sigmas = f"{1000 * params.elevation_sigma:g} and {1000 * params.bearing_sigma:g} mrad"
    return [
        [
            "mean T2T",
            "called track-to-truth, no formula; values up to 1.6",
            "both readings that can exceed 1: "
            "tracks ever initiated per truth (Stone Soup's `BasicMetrics`), and live tracks per living truth",
        ],
        [
            "mean covariance norm",
            "full 6x6 covariance, unit printed as m",
            "mean over live tracks; with no track a step counts 0, or is left out",
        ],
        [
            "GOSPA",
            "cut-off, order and space not given",
            f"c = {params.gospa_cutoff:g} m, p = {params.gospa_order:g}, "
            "positions only; parts are p-th powers, as in Stone Soup",
        ],
        ["length of an episode", "not given", f"{int(params.max_steps_in_episode)} steps"],
        ["number of targets", '"a fixed set"', f"{static.num_truths}"],
        ["where targets are", "not given", f"direction uniform in the field, range uniform in {kilometres}"],
        [
            "how targets move",
            "constant velocity",
            f"velocity {params.truth_velocity_sigma:g} m/s per axis (sigma), "
            f"white acceleration {params.truth_process_noise:g} m²/s³",
        ],
        [
            "measurement noise",
            "not given",
            f"elevation and bearing {sigmas}, range {params.range_sigma:g} m (sigma)",
        ],
        [
            "detection probability, clutter",
            "not given",
            f"{params.detection_probability:g}; {params.clutter_rate:g} false detections per look",
        ],
        [
            "gate and missed distance",
            "not given",
            f"{params.gate_threshold:g} and {params.missed_distance:g} (Mahalanobis)",
        ],
        [
            "deleter threshold 5000",
            "of what is not said",
            f"trace of the 6x6 covariance above {params.deletion_threshold:g}",
        ],
        [
            "initiator",
            "prior not given",
            f"single measurement, prior velocity {params.prior_velocity_sigma:g} m/s (sigma)",
        ],
        [
            "scan value",
            "named, no formula",
            f"1 - exp(-t / {params.scan_time_constant:g} s), t since the last look",
        ],
        [
            "reward",
            "sign of the track term pays for growing covariance",
            f"`{static.reward}` here: the return's row depends on it, no other metric does",
        ],
        ["spread of the results", "± not explained", "95 % bootstrap interval of the mean over scenarios"],
    ]
