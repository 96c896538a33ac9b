"""What the agent sees, in numpy: the same numbers as `jaxtrack.observation` and `scan_map`."""

from collections.abc import Sequence

import numpy as np
from stonesoup.functions import cart2sphere
from stonesoup.types.track import Track

from jaxtrack.observation import TRACK_FEATURES
from jaxtrack.params import Params, StaticParams
from jaxtrack.types import POSITION, VELOCITY
from reference.translate import as_vector, track_key


class TrackSlots:
    """Gives every track of Stone Soup's set a slot for life, as `jaxtrack.lifecycle` does.

    Attributes:
        tracks: the track in each slot, None where it is free.
    """

    def __init__(self, max_tracks: int) -> None:
        self.tracks: list[Track | None] = [None] * max_tracks

    def update(self, live: set[Track]) -> None:
        """Frees the slots of dead tracks, then gives new tracks, in order, the first free slots."""
        self.tracks = [track if track in live else None for track in self.tracks]
        waiting = sorted(live - set(self.tracks), key=track_key)
        free = (slot for slot, track in enumerate(self.tracks) if track is None)
        for slot, track in zip(list(free), waiting, strict=False):
            self.tracks[slot] = track


def track_observation(slots: Sequence[Track | None], params: Params) -> tuple[np.ndarray, np.ndarray]:
    """Scaled features `[T, 7]`, zero where there is no track, and mask `[T]`."""
    features = np.zeros((len(slots), TRACK_FEATURES))
    for slot, track in enumerate(slots):
        if track is not None:
            features[slot] = track_features(track) / feature_scales(params)
    return features, np.array([track is not None for track in slots])


def track_features(track: Track) -> np.ndarray:
    """Range (m), azimuth, elevation (rad), vx, vy, vz (m/s), Frobenius norm of P."""
    mean = as_vector(track.state_vector)
    distance, azimuth, elevation = cart2sphere(*mean[list(POSITION)])
    norm = np.linalg.norm(track.covar)
    return np.array([distance, azimuth, elevation, *mean[list(VELOCITY)], norm])


def feature_scales(params: Params) -> np.ndarray:
    """Fixed divisors `[7]` that bring the features near [-1, 1]."""
    speed = 3 * params.prior_velocity_sigma
    angle = params.field_limit
    return np.array([params.max_range, angle, angle, speed, speed, speed, params.deletion_threshold])


class ScanMap:
    """Scan value ``1 - exp(-(t - t_last look) / tau)`` of every pixel.

    Attributes:
        value: `[M, M]`; row is elevation, column is azimuth, both rising.
    """

    def __init__(self, static: StaticParams, params: Params) -> None:
        self.params = params
        self.decay = np.exp(-params.time_step / params.scan_time_constant)
        self.value = np.ones((static.map_size, static.map_size))
        angles = params.field_limit * np.linspace(-1.0, 1.0, static.map_size)
        azimuth, elevation = np.meshgrid(angles, angles)
        self.pixels = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )

    def look(self, azimuth: float, elevation: float) -> None:
        """Ages the map by one step and clears the beam, by its angles in the boresight frame."""
        cos_az, sin_az, cos_el, sin_el = (
            np.cos(azimuth),
            np.sin(azimuth),
            np.cos(elevation),
            np.sin(elevation),
        )
        to_boresight = np.array(
            [
                [cos_el * cos_az, cos_el * sin_az, sin_el],
                [-sin_az, cos_az, 0.0],
                [-sin_el * cos_az, -sin_el * sin_az, cos_el],
            ]
        )
        x, y, z = np.tensordot(to_boresight, self.pixels, axes=1)
        in_bearing = np.abs(np.arctan2(y, x)) <= self.params.beam_azimuth / 2
        in_elevation = np.abs(np.arcsin(z)) <= self.params.beam_elevation / 2
        self.value = 1 - (1 - self.value) * self.decay
        self.value[in_bearing & in_elevation] = 0.0
