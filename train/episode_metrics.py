"""What is measured of an episode: step by step while it is played, and of the whole afterwards."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import struct
from scipy.stats import chi2

from jaxtrack import metrics
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState, StepRecord
from jaxtrack.kernel import stage
from jaxtrack.params import Params
from jaxtrack.reward import reward_terms
from jaxtrack.scan_map import mean_scan_value
from jaxtrack.sensor import look_number
from jaxtrack.siap import siap
from jaxtrack.types import STATE_DIM, Tracks, Truths, position

METRICS = {
    "gospa": "GOSPA distance (m)",
    "gospa_localisation": "GOSPA localisation (m^p)",
    "gospa_missed": "GOSPA missed (m^p)",
    "gospa_false": "GOSPA false (m^p)",
    "completeness": "completeness",
    "uncertainty_per_truth": "uncertainty per truth (m²)",
    "track_to_target_ratio": "tracks ever initiated per truth",
    "mean_track_to_target_ratio": "live tracks per living truth",
    "covariance_norm_mean": "mean covariance norm (m²)",
    "covariance_norm_when_tracking": "mean covariance norm, steps with a track (m²)",
    "covariance_norm_sum": "sum of covariance norms (m²)",
    "siap_completeness": "SIAP completeness",
    "siap_ambiguity": "SIAP ambiguity",
    "siap_spuriousness": "SIAP spuriousness",
    "siap_position_accuracy": "SIAP position accuracy (m)",
    "siap_velocity_accuracy": "SIAP velocity accuracy (m/s)",
    "siap_track_change_rate": "SIAP rate of track number change (1/s)",
    "siap_longest_segment": "SIAP longest track segment",
    "time_to_first_track": "time to first track (s)",
    "truths_ever_tracked": "truths ever tracked",
    "track_breaks": "tracks beyond the first of each truth",
    "nees": "NEES / 6",
    "nees_inside": "NEES within its 95 % band",
    "mean_scan_value": "mean scan value",
    "episode_return": "return",
}
"""Metrics of an episode with their labels; `train/README.md` defines each."""

CURVES = {
    "covariance_x": "variance of x (m²)",
    "covariance_y": "variance of y (m²)",
    "covariance_z": "variance of z (m²)",
    "covariance_norm": "covariance norm (m²)",
    "gospa": "GOSPA distance (m)",
    "gospa_localisation": "GOSPA localisation (m^p)",
    "gospa_missed": "GOSPA missed (m^p)",
    "gospa_false": "GOSPA false (m^p)",
    "completeness": "completeness",
}
"""What is kept of every step; the covariances are means over live tracks, NaN without one."""

NEES_BAND = tuple(float(end) for end in chi2.ppf((0.025, 0.975), STATE_DIM))
"""Ends of the 95 % band of a consistent filter's NEES."""


class StepRow(struct.PyTreeNode):
    """What one step leaves for the metrics of the whole episode.

    Attributes:
        values: scalars by name.
        truths: the truths after the step.
        tracks: the tracks after the step, as much as SIAP needs of them.
        tracked: `[N]` which truths have a track within the GOSPA cut-off.
        look: number of the look nearest to where the radar looked.
    """

    values: dict[str, jax.Array]
    truths: Truths
    tracks: Tracks
    tracked: jax.Array
    look: jax.Array


def step_row(
    before: EnvState, after: EnvState, record: StepRecord, env: SearchTrack, params: Params
) -> StepRow:
    """Everything that is measured of one step."""
    truths, tracks = after.truths, after.tracks
    reward = reward_terms(before.tracks, tracks, truths, after.scan_map, env.static, params)
    distances = metrics.position_distances(truths, tracks)
    values = {
        **_gospa(truths, tracks, params),
        **covariances(tracks),
        **_consistency(truths, tracks, distances, params),
        "completeness": metrics.completeness(truths, tracks, params),
        "covariance_norm_mean": metrics.covariance_norm_mean(tracks),
        "covariance_norm_sum": metrics.covariance_norm_sum(tracks),
        "uncertainty_per_truth": metrics.uncertainty_per_truth(truths, tracks, params),
        "mean_scan_value": mean_scan_value(after.scan_map),
        "reward": reward[0] + reward[1],
    }
    return StepRow(
        values=values,
        truths=truths,
        tracks=tracks.replace(covariance=None, root=None, updated_by=None, age=None),
        tracked=jnp.any(distances < params.gospa_cutoff, axis=-1),
        look=look_number(record.look, env.static, params),
    )


def episode_values(rows: StepRow, params: Params) -> dict[str, jax.Array]:
    """Every metric of `METRICS`, from the rows `[K, ...]` of an episode."""
    values = rows.values
    times = params.time_step * jnp.arange(1, rows.look.shape[0] + 1)
    over_record = vars(siap(rows.truths, rows.tracks, times, params))
    counts = metrics.basic_metrics(rows.truths, rows.tracks)
    num_tracked = jnp.sum(jnp.any(rows.tracked, axis=0))
    compared = jnp.sum(values["nees_count"])
    found = {
        **{name: jnp.mean(value) for name, value in values.items()},
        **{f"siap_{name}": value for name, value in over_record.items()},
        "covariance_norm_when_tracking": jnp.nanmean(values["covariance_norm"]),
        "track_to_target_ratio": counts.track_to_target_ratio,
        "mean_track_to_target_ratio": counts.mean_ratio,
        "time_to_first_track": mean_wait(rows.truths.alive, rows.tracked, params),
        "truths_ever_tracked": num_tracked / jnp.maximum(counts.num_truths, 1),
        "track_breaks": counts.num_tracks - num_tracked,
        "nees": jnp.sum(values["nees_sum"]) / compared / STATE_DIM,
        "nees_inside": jnp.sum(values["nees_inside"]) / compared,
        "episode_return": jnp.sum(values["reward"]),
    }
    return {name: found[name] for name in METRICS}


def episode_curves(values: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """The values `[K]` that are kept of every step."""
    return {name: values[name] for name in CURVES}


def mean_wait(alive: jax.Array, tracked: jax.Array, params: Params) -> jax.Array:
    """Mean time (s) from a truth's first step to the first one with a track near it, both included.

    A truth that is never tracked counts the length of the episode.

    Args:
        alive: `[K, N]`.
        tracked: `[K, N]`.
        params: numbers of the scenario.
    """
    waited = jnp.argmax(tracked, axis=0) - jnp.argmax(alive, axis=0) + 1
    steps = jnp.where(jnp.any(tracked, axis=0), waited, alive.shape[0])
    lived = jnp.any(alive, axis=0)
    return params.time_step * jnp.sum(jnp.where(lived, steps, 0)) / jnp.maximum(jnp.sum(lived), 1)


@stage
def nees(error: jax.Array, covariance: jax.Array) -> jax.Array:
    """Normalised estimation errors squared ``e' P^-1 e`` `[...]` of errors `[..., 6]`, `[..., 6, 6]`.

    ``sum of w^2 / d`` with ``P = L D L'`` and ``e = L w``, entry by entry: without arrays of entries
    a CPU works it out in few loops over the tracks.
    """
    products: list[list[jax.Array]] = []  # rows of L D
    inverse: list[jax.Array] = []
    white: list[jax.Array] = []
    for i in range(STATE_DIM):
        product: list[jax.Array] = []
        row: list[jax.Array] = []
        for j in range(i):
            product.append(covariance[..., i, j] - _dot(row, products[j]))
            row.append(product[j] * inverse[j])
        inverse.append(1 / (covariance[..., i, i] - _dot(row, product)))
        white.append(error[..., i] - _dot(row, white))
        products.append(product)
    return _dot([w * w for w in white], inverse)


def _dot(a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
    """Of as many entries as both have."""
    return sum((x * y for x, y in zip(a, b, strict=False)), start=jnp.zeros(()))


def _gospa(truths: Truths, tracks: Tracks, params: Params) -> dict[str, jax.Array]:
    found = metrics.gospa(truths, tracks, params)
    return {
        "gospa": found.distance,
        "gospa_localisation": found.localisation,
        "gospa_missed": found.missed,
        "gospa_false": found.false,
    }


def covariances(tracks: Tracks) -> dict[str, jax.Array]:
    """Means over live tracks; NaN without one."""
    number = jnp.sum(tracks.active)
    variances = jnp.diagonal(tracks.covariance, axis1=-2, axis2=-1)
    x, y, z = jnp.sum(jnp.where(tracks.active[:, None], position(variances), 0.0), axis=0) / number
    norm = jnp.where(number > 0, metrics.covariance_norm_mean(tracks), jnp.nan)
    return {"covariance_x": x, "covariance_y": y, "covariance_z": z, "covariance_norm": norm}


def _consistency(
    truths: Truths, tracks: Tracks, distances: jax.Array, params: Params
) -> dict[str, jax.Array]:
    """NEES over the tracks with a truth within the cut-off: sum, number, and how many in the band."""
    distance, nearest = metrics.nearest(distances)
    near = distance < params.gospa_cutoff
    error = jnp.where(near[:, None], truths.state[nearest] - tracks.mean, 0.0)
    covariance = jnp.where(near[:, None, None], tracks.covariance, jnp.eye(STATE_DIM))
    value = nees(error, covariance)
    low, high = NEES_BAND
    return {
        "nees_sum": jnp.sum(jnp.where(near, value, 0.0)),
        "nees_count": jnp.sum(near),
        "nees_inside": jnp.sum(near & (low <= value) & (value <= high)),
    }
