"""Every number of the scenario, the tracker and the reward, once, with its unit.

`StaticParams` are shapes and choices of code: hashable, changing one recompiles.
`Params` are numbers: traced, so that changing them recompiles nothing and `jax.vmap` over
them gives curricula and domain randomisation.
"""

import dataclasses
import math
from typing import Any

import jax
from flax import struct

REWARDS = ("paper", "as_printed", "information", "shortfall", "gospa")
METRICS = (
    "gospa",
    "gospa_localisation",
    "gospa_missed",
    "gospa_false",
    "completeness",
    "uncertainty_per_truth",
    "covariance_norm_sum",
    "covariance_norm_mean",
)
MEASURES = (
    "mahalanobis",
    "squared_mahalanobis",
    "euclidean",
    "kullback_leibler",
    "hellinger",
    "squared_hellinger",
)
FILTERS = ("unscented", "extended", "cubature", "converted")
COVARIANCE_FORMS = ("full", "square_root")
ASSOCIATORS = ("nearest_neighbour", "global_nearest_neighbour")
DELETERS = ("covariance", "update_time", "update_time_steps")
INITIATORS = ("single_measurement", "multi_measurement")
CONVERTED_MEASURES = ("mahalanobis", "squared_mahalanobis", "euclidean")
"""Measures for the filter `converted`: those that need no noise of one size for all detections."""

LARGEST = 1e9
"""Largest number allowed where nothing smaller is: its fourth power is still a number in float32."""
LARGEST_SHAPES = {"map_size": 4096, "num_looks": 1000}
"""Largest shapes by name; all others end at `LARGEST_SHAPE`."""
LARGEST_SHAPE = 10_000
SMALLEST_SHAPES = {"max_clutter": 0, "map_size": 2, "num_looks": 2}
"""Smallest shapes by name; all others begin at 1."""


def looks_per_axis(field: float, beam: float) -> int:
    """Looks per axis so that overlapping beams cover the field (paper, eq. 1).

    Args:
        field: total extent of the field (rad).
        beam: extent of the beam (rad).
    """
    return math.ceil(round(field / (beam * math.sqrt(2) / 2), 9))


@dataclasses.dataclass(frozen=True)
class StaticParams:
    """Shapes and choices of code (hashable; a change recompiles)."""

    num_truths: int = 10
    """Truths that can exist in one episode, those born later included."""
    max_tracks: int = 20
    """Track slots; an excess is dropped and counted in `info`."""
    max_detections: int = 10
    """Detection slots per look; an excess is dropped and counted in `info`."""
    max_clutter: int = 8
    """Largest number of false detections in one look."""
    map_size: int = 48
    """Pixels along each side of the scan map."""
    num_looks: int = 19
    """Looks along each axis of the field."""
    continuous_actions: bool = False
    """Actions are (azimuth, elevation) in radians instead of two look indices."""
    observe_variances: bool = False
    """The observation also has `variances`, of position and of velocity of every track (not the paper's)."""
    reward: str = "paper"
    """Reward by name: paper, as_printed, information, shortfall or gospa (which reads the truths)."""
    search_sharpness: int = 1
    """Power of every scan value in the reward's search term; a high one counts only what was never
    seen, or long ago."""
    search_until_complete: bool = False
    """The reward's search term is 0 while there are as many confirmed tracks as there can be truths."""
    info_metrics: tuple[str, ...] = ()
    """More metrics of every step for `info`, by name; `jaxtrack.metrics.METRICS` lists them."""
    stop_metric: str | None = None
    """Metric that ends an episode as soon as it exceeds `stop_threshold`; unset, none does."""
    measure: str = "mahalanobis"
    """Distance of a detection from a track: mahalanobis, squared_mahalanobis, euclidean,
    kullback_leibler, hellinger or squared_hellinger; the gate has its unit."""
    filter: str = "unscented"
    """Kalman filter of the tracks: unscented, extended, cubature, or converted (linear, on detections
    converted to positions)."""
    covariance_form: str = "full"
    """What the filter carries: full covariances, or square_root (their triangular factors), for float32
    with noise or priors so extreme that full ones break."""
    associator: str = "nearest_neighbour"
    """Which detection belongs to which track: nearest_neighbour (greedy) or global_nearest_neighbour
    (the least total distance)."""
    deleters: tuple[str, ...] = ("covariance",)
    """What deletes a track, one or more of: covariance, update_time, update_time_steps."""
    intersect_deleters: bool = False
    """A track is deleted only if all `deleters` say so, instead of any of them."""
    initiator: str = "single_measurement"
    """single_measurement: every detection of no track is a new track. multi_measurement: it is a tentative
    one, which enters the track list after `min_points` detections."""
    min_points: int = 2
    """Detections that a tentative track needs to enter the track list."""

    def __post_init__(self) -> None:
        """Refuses shapes that make no sense, naming the field."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type is int:
                low = SMALLEST_SHAPES.get(field.name, 1)
                high = LARGEST_SHAPES.get(field.name, LARGEST_SHAPE)
                if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                    raise ValueError(f"{field.name} = {value!r}: expected an integer in [{low}, {high}]")
            elif field.type is bool and not isinstance(value, bool):
                raise ValueError(f"{field.name} = {value!r}: expected True or False")
        for name in ("info_metrics", "deleters"):
            if not isinstance(getattr(self, name), tuple):
                raise ValueError(f"{name} = {getattr(self, name)!r}: expected a tuple of names")
        if not self.deleters:
            raise ValueError(f"deleters = (): expected one or more of {', '.join(DELETERS)}")
        choices: list[tuple[str, Any, tuple[str, ...]]] = [
            ("reward", self.reward, REWARDS),
            ("measure", self.measure, MEASURES),
            ("filter", self.filter, FILTERS),
            ("covariance_form", self.covariance_form, COVARIANCE_FORMS),
            ("associator", self.associator, ASSOCIATORS),
            ("initiator", self.initiator, INITIATORS),
        ]
        choices += [("deleters", name, DELETERS) for name in self.deleters]
        choices += [("info_metrics", name, METRICS) for name in self.info_metrics]
        choices += [("stop_metric", self.stop_metric, METRICS)] if self.stop_metric is not None else []
        for field_name, chosen, known in choices:
            if not isinstance(chosen, str) or chosen not in known:
                raise ValueError(f"{field_name} = {chosen!r}: expected one of {', '.join(known)}")
        if self.filter == "converted" and self.measure not in CONVERTED_MEASURES:
            raise ValueError(
                f"measure = {self.measure!r}: expected one of {', '.join(CONVERTED_MEASURES)} "
                "with filter = 'converted'"
            )


def _quantity(
    default: float | None, unit: str, low: float, high: float = LARGEST, open_low: bool = False
) -> Any:
    """A traced number with its unit and the range that `validate` allows; None where it may be unset."""
    return struct.field(
        default=default,
        metadata={"unit": unit, "low": low, "high": high, "open_low": open_low},
    )


@struct.dataclass
class Params:
    """Numbers of the scenario, the tracker and the reward (traced; a change recompiles nothing)."""

    time_step: float = _quantity(0.005, "s", 0.0, 1e6, open_low=True)
    """Time between looks (s)."""
    max_steps_in_episode: int = _quantity(1000, "steps", 1)  # gymnax reads this name
    """Length of an episode (steps)."""

    field_limit: float = _quantity(math.pi / 3, "rad", 0.0, math.pi / 2, open_low=True)
    """Azimuth and elevation of the field lie within plus or minus this (rad)."""
    beam_azimuth: float = _quantity(math.radians(9), "rad", 0.0, math.pi, open_low=True)
    """Full width of the beam in boresight bearing (rad)."""
    beam_elevation: float = _quantity(math.radians(9), "rad", 0.0, math.pi, open_low=True)
    """Full width of the beam in boresight elevation (rad)."""

    min_range: float = _quantity(1_000.0, "m", 1.0)
    """Smallest range at which a truth is born (m)."""
    max_range: float = _quantity(10_000.0, "m", 1.0)
    """Largest range at which a truth is born; scale of the range observation (m)."""
    truth_velocity_sigma: float = _quantity(30.0, "m/s", 0.0)
    """Standard deviation of a truth's initial velocity, each axis (m/s)."""
    truth_process_noise: float = _quantity(1.0, "m^2/s^3", 0.0)
    """Spectral density of the truths' white acceleration; 0 switches it off (m^2/s^3)."""
    truth_turn_rate: float | None = _quantity(None, "rad/s", 0.0, 1e3)
    """Truths turn about the vertical: their rates are spread evenly from minus to plus this over the
    rows (rad/s); unset, they do not."""
    truth_acceleration: float | None = _quantity(None, "m/s^2", 0.0, 1e4)
    """Every truth has a constant acceleration of this size, the rows' directions spread evenly over the
    sphere (m/s^2); unset, none has."""
    initial_truths: int | None = None
    """Truths alive at the start; unset, all of them."""
    birth_rate: float = _quantity(0.0, "1/step", 0.0, 80.0)  # e^-80 is still a number in float32
    """Expected number of truths born per step."""
    death_probability: float = _quantity(0.0, "1/step", 0.0, 1.0)
    """Probability that a truth ends in a step."""
    trajectories: jax.Array | None = None
    """Recorded truths `[K, N, 6]` to replay instead of simulating; NaN where absent."""

    platform_speed: float = _quantity(0.0, "m/s", 0.0)
    """The radar's platform flies ahead, along its x axis, at this known speed; all positions and velocities
    are relative to it (m/s)."""
    platform_turn_rate: float | None = _quantity(None, "rad/s", -1e3, 1e3)
    """Its heading turns about the vertical, to the left where positive, at this known rate, by the number of
    the step times `time_step`; the frame keeps its axes (rad/s). Unset, it flies straight on."""
    elevation_sigma: float = _quantity(2e-3, "rad", 0.0, math.pi, open_low=True)
    """Standard deviation of measured elevation (rad)."""
    bearing_sigma: float = _quantity(2e-3, "rad", 0.0, math.pi, open_low=True)
    """Standard deviation of measured bearing (rad)."""
    range_sigma: float = _quantity(5.0, "m", 0.0, open_low=True)
    """Standard deviation of measured range (m)."""
    detection_probability: float = _quantity(1.0, "1", 0.0, 1.0)
    """Probability that a truth in the beam is detected."""
    clutter_rate: float = _quantity(0.0, "1/look", 0.0, 80.0)
    """Expected number of false detections per look."""

    process_noise: float = _quantity(1.0, "m^2/s^3", 0.0)
    """Spectral density of the white acceleration that the filter assumes (m^2/s^3)."""
    alpha: float = _quantity(0.5, "1", 0.0, open_low=True)
    """Unscented transform: primary spread of the sigma points."""
    beta: float = _quantity(2.0, "1", 0.0)
    """Unscented transform: prior knowledge of the distribution (2 is best for a Gaussian)."""
    kappa: float = _quantity(-3.0, "1", -5.0)
    """Unscented transform: secondary spread of the sigma points."""
    gate_threshold: float = _quantity(5.0, "1", 0.0, open_low=True)
    """A detection is considered if its distance is smaller than this (unit of the measure)."""
    missed_distance: float = _quantity(5.0, "1", 0.0, open_low=True)
    """Distance at which a missed detection is the better explanation (unit of the measure)."""
    prior_velocity_sigma: float = _quantity(30.0, "m/s", 0.0, open_low=True)
    """Standard deviation of a new track's velocity, each axis (m/s)."""
    deletion_threshold: float = _quantity(5_000.0, "m^2 + m^2/s^2", 0.0, 1e18, open_low=True)
    """Deleter covariance: a track is deleted when the trace of its covariance exceeds this."""
    deletion_time: float | None = _quantity(None, "s", 0.0, 1000.0, open_low=True)
    """Deleter update_time: a track is deleted when its last detection is longer ago than this (s)."""
    deletion_steps: int | None = _quantity(None, "steps", 1, 1e6)
    """Deleter update_time_steps: a track is deleted after this many steps in a row without a detection."""

    scan_time_constant: float = _quantity(1.0, "s", 0.0, open_low=True)
    """Time in which the scan value of an unobserved direction recovers to 1 - 1/e (s)."""
    track_weight: float = _quantity(1.0, "1", 0.0)
    """Weight of the reward's track term."""
    search_weight: float = _quantity(0.5, "1", 0.0)
    """Weight of the reward's search term."""
    stop_threshold: float | None = None
    """An episode ends when `stop_metric` exceeds this (the metric's unit)."""
    gospa_cutoff: float = _quantity(200.0, "m", 0.0, 1e6, open_low=True)
    """GOSPA cut-off c; also the distance within which a track counts for a truth (m)."""
    gospa_order: float = _quantity(2.0, "1", 1.0, 5.0)
    """GOSPA order p."""
    gospa_switching_penalty: float = _quantity(0.0, "m", 0.0)
    """GOSPA over time: cost of a truth passing from one track to another; 0 switches it off (m)."""
    siap_threshold: float = _quantity(200.0, "m", 0.0, open_low=True)
    """SIAP: a track can belong to a truth only while it is closer than this (m)."""
    siap_confirm_steps: int = _quantity(3, "steps", 2)
    """SIAP: a track belongs to a truth after this many steps in a row, from the first of them on."""
    siap_end_steps: int = _quantity(2, "steps", 1)
    """SIAP: a track no longer belongs to its truth after this many steps in a row away from it."""
