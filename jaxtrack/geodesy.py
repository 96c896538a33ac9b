"""Where things are on the Earth, seen from a radar on the ground.

Geodesy is WGS84 (NIMA TR8350.2): geodetic coordinates to Earth-centred ones, then to the plane
that touches the ellipsoid at the radar. The Earth falls away below that plane, so that far
aircraft sink under the horizon by themselves.
"""

import dataclasses
import math

import numpy as np

from jaxtrack.types import STATE_DIM

SEMI_MAJOR_AXIS = 6_378_137.0
"""WGS84 a (m)."""
FLATTENING = 1 / 298.257223563
"""WGS84 f."""

_GRID, _HEADINGS = 12, 36  # places along each side, headings at each place


@dataclasses.dataclass(frozen=True)
class Radar:
    """Where the platform frame lies: x along the heading, y to its left, z up.

    Attributes:
        latitude: geodetic (deg, north positive).
        longitude: (deg, east positive).
        altitude: above the WGS84 ellipsoid (m).
        heading: of the x axis, clockwise from north (deg).

    Raises:
        ValueError: naming the coordinate that lies on no Earth.
    """

    latitude: float
    longitude: float
    altitude: float = 0.0
    heading: float = 0.0

    def __post_init__(self) -> None:
        """Refuses coordinates out of range."""
        limits = {"latitude": 90.0, "longitude": 180.0, "altitude": 1e5, "heading": 360.0}
        for name, limit in limits.items():
            if not abs(getattr(self, name)) <= limit:
                raise ValueError(
                    f"{name} = {getattr(self, name)}: expected a number in [-{limit:g}, {limit:g}]"
                )


def earth_centred(place: np.ndarray) -> np.ndarray:
    """Earth-centred, Earth-fixed positions `[..., 3]` (m) of latitude, longitude (deg), altitude (m).

    ``N = a / sqrt(1 - e^2 sin^2 phi)``, then ``(N + h) cos phi cos lambda``,
    ``(N + h) cos phi sin lambda``, ``(N (1 - e^2) + h) sin phi`` (TR8350.2, eq. 4-14).
    """
    latitude, longitude = np.radians(place[..., 0]), np.radians(place[..., 1])
    altitude = place[..., 2]
    e_squared = FLATTENING * (2 - FLATTENING)
    N = SEMI_MAJOR_AXIS / np.sqrt(1 - e_squared * np.sin(latitude) ** 2)
    ground = (N + altitude) * np.cos(latitude)
    z = (N * (1 - e_squared) + altitude) * np.sin(latitude)
    return np.stack([ground * np.cos(longitude), ground * np.sin(longitude), z], axis=-1)


def east_north_up(place: np.ndarray) -> np.ndarray:
    """Earth-centred unit vectors `[..., 3, 3]`, row by row east, north and up, at places `[..., 3]`."""
    latitude, longitude = np.radians(place[..., 0]), np.radians(place[..., 1])
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(sin_lon)], axis=-1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return np.stack([east, north, up], axis=-2)


def to_radar(
    place: np.ndarray, velocity: np.ndarray, radar: Radar, age: np.ndarray | float = 0.0
) -> np.ndarray:
    """States `[R, 6]` in the platform frame.

    Args:
        place: `[R, 3]` latitude, longitude (deg), altitude above the ellipsoid (m).
        velocity: `[R, 3]` east, north, up at the place itself (m/s).
        radar: where the frame lies.
        age: `[R]` or one number: how long ago the place was that (s).
    """
    origin = np.array([radar.latitude, radar.longitude, radar.altitude])
    axes = _turn(radar.heading) @ east_north_up(origin)
    v = np.einsum("rji,rj->ri", east_north_up(place), velocity)
    offset = earth_centred(place) - earth_centred(origin) + v * np.reshape(age, (-1, 1))
    return np.stack([offset @ axes.T, v @ axes.T], axis=-1).reshape(-1, STATE_DIM)


def to_east_north(states: np.ndarray, radar: Radar) -> np.ndarray:
    """Positions east and north of the radar `[..., 2]` (m) of states `[..., 6]`, for maps."""
    return (states[..., 0::2] @ _turn(radar.heading))[..., :2]


def place_radar(place: np.ndarray, field_limit: float, max_range: float) -> Radar:
    """The radar that has most of the places `[R, 3]` in view, of a grid over their area.

    In view is within `max_range` (m), above the horizon, and within `field_limit` (rad) of the
    x axis in azimuth and of the horizon in elevation. Its altitude is 0.
    """
    low, high = place[:, :2].min(axis=0), place[:, :2].max(axis=0)
    headings = np.arange(_HEADINGS) * 360.0 / _HEADINGS
    best, most = Radar(*low.tolist()), -1
    for latitude in np.linspace(low[0], high[0], _GRID):
        for longitude in np.linspace(low[1], high[1], _GRID):
            radar = Radar(float(latitude), float(longitude))
            x, y, z = to_radar(place, np.zeros_like(place), radar)[:, 0::2].T  # x north, y west
            ground, distance = np.hypot(x, y), np.sqrt(x**2 + y**2 + z**2)
            inside = (z >= 0) & (z <= math.sin(field_limit) * distance) & (distance <= max_range)
            along = np.outer(x, np.cos(np.radians(headings))) - np.outer(y, np.sin(np.radians(headings)))
            count = np.sum(inside[:, None] & (along >= math.cos(field_limit) * ground[:, None]), axis=0)
            if count.max() > most:
                most = count.max()
                best = dataclasses.replace(radar, heading=float(headings[np.argmax(count)]))
    return best


def _turn(heading: float) -> np.ndarray:
    """Rotation `[3, 3]` from east, north, up to forward, left, up."""
    sin, cos = math.sin(math.radians(heading)), math.cos(math.radians(heading))
    return np.array([[sin, cos, 0.0], [-cos, sin, 0.0], [0.0, 0.0, 1.0]])
