"""The records that an episode is made of: the state, the noise of a step, and what happened in it."""

import jax
from flax import struct
from gymnax.environments import environment

from jaxtrack.params import StaticParams
from jaxtrack.sampling import draw
from jaxtrack.sensor import SensorNoise, cut_noise, num_draws
from jaxtrack.tracker import TrackerInfo
from jaxtrack.truth import TruthNoise, cut_truth_noise, num_truth_draws
from jaxtrack.types import Detections, Tracks, Truths


@struct.dataclass
class EnvState(environment.EnvState):
    """State of one scenario.

    Attributes:
        time: `[]` steps since the start.
        truths: the true targets; no policy may read them.
        tracks: the track list.
        scan_map: `[M, M]` scan value of every pixel.
        num_born: `[]` truths born since the start, those that found no row included.
        num_initiated: `[]` tracks initiated since the start.
    """

    time: jax.Array
    truths: Truths
    tracks: Tracks
    scan_map: jax.Array  # [M, M]
    num_born: jax.Array
    num_initiated: jax.Array


class StepNoise(struct.PyTreeNode):
    """All that is random in one step.

    Attributes:
        truths: the draws of motion, deaths and births.
        sensor: the draws of the look.
    """

    truths: TruthNoise
    sensor: SensorNoise


class StepRecord(struct.PyTreeNode):
    """What happened in one step, for rendering and parity tests.

    Attributes:
        look: `[2]` boresight azimuth and elevation (rad).
        detections: what the look returned.
        num_dropped_truths: `[]` births for which no row was left.
        num_dropped_detections: `[]` detections for which no slot was free.
        num_dropped_tracks: `[]` new tracks for which no slot was free.
        tracker: every intermediate of the tracker, or None where `play` left it out.
    """

    look: jax.Array
    detections: Detections
    num_dropped_truths: jax.Array
    num_dropped_detections: jax.Array
    num_dropped_tracks: jax.Array
    tracker: TrackerInfo | None


def sample_step_noise(key: jax.Array, static: StaticParams) -> StepNoise:
    """Draws all that is random in one step; the key is consumed."""
    for_truths, for_sensor = num_truth_draws(static.num_truths), num_draws(static)
    # In one draw for both: short draws cost more than the numbers themselves.
    normal, uniform = draw(key, *map(sum, zip(for_truths, for_sensor, strict=True)))
    truths = cut_truth_noise(normal[: for_truths[0]], uniform[: for_truths[1]])
    sensor = cut_noise(normal[for_truths[0] :], uniform[for_truths[1] :], static)
    return StepNoise(truths=truths, sensor=sensor)
