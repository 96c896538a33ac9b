"""A policy of ours, trained or not, as Stone Soup's sensor manager.

manager = PolicyManager(POLICIES["index"], static, params, sensors={radar})
((config,),) = (manager.choose_actions(tracker.tracks, time),)
radar.add_actions(config[radar])
radar.act(time)
"""

import datetime
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from stonesoup.base import Property
from stonesoup.sensor.radar.radar import RadarRotatingElevationBearingRange
from stonesoup.sensormanager import SensorManager
from stonesoup.sensormanager.action import Action, ActionGenerator, RealNumberActionGenerator
from stonesoup.types.angle import Angle, Bearing
from stonesoup.types.track import Track

from jaxtrack.episode import EnvState
from jaxtrack.params import Params, StaticParams
from jaxtrack.platform import rotation, to_platform
from jaxtrack.policies import PolicyBuilder
from jaxtrack.scan_map import initial_scan_map, update_scan_map
from jaxtrack.sensor import look_angles
from jaxtrack.types import NEVER, NO_DETECTION, STATE_DIM, Tracks, Truths
from jaxtrack.validation import validate
from reference.components import EPOCH
from reference.radar import build_radar
from reference.stone_soup_objects import take_slots
from reference.translate import fill_slots, on_device

AXES = ("dwell_centre", "tilt_centre")
"""What the radar's actions turn: azimuth, then elevation."""


class PolicyManager(SensorManager):
    """Steers one radar that turns in azimuth and elevation, by a policy of ours.

    Between two decisions it keeps what else the policy sees: the scan map, the slots that tracks hold,
    and the number of steps. States of tracks are x, vx, y, vy, z, vz (m, m/s); the radar may stand
    anywhere and be oriented at will.

    Raises:
        ValueError: naming the field, if a number is out of range or if there is not one such radar.
    """

    build_policy: PolicyBuilder = Property(doc="Builder of the policy, as in `jaxtrack.policies.POLICIES`.")
    static: StaticParams = Property(doc="Shapes; more tracks than slots are not seen.")
    params: Params = Property(doc="Numbers of the scenario; the beam and the field are those of the radar.")
    seed: int = Property(default=0, doc="Of a policy that draws.")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        validate(self.static, self.params)
        if len(self.sensors) != 1:
            raise ValueError(f"sensors: {len(self.sensors)} of them; expected one radar")
        (self.radar,) = self.sensors
        missing = [axis for axis in AXES if not hasattr(self.radar, axis)]
        if missing:
            raise ValueError(f"sensors: {type(self.radar).__name__} without {' and '.join(missing)}")
        self._policy = self.build_policy(self.static, self.params)
        self._decide, self._see = jax.jit(self._look), jax.jit(self._scan)
        self.reset()

    def reset(self) -> None:
        """Begins anew: a field never seen, no tracks known."""
        self.step = 0
        self.last_time: datetime.datetime | None = None
        self.slots: list[Track | None] = [None] * self.static.max_tracks
        self.scan_map = initial_scan_map(self.static)

    def choose_actions(
        self, tracks: Collection[Track], timestamp: datetime.datetime, nchoose: int = 1, **kwargs: Any
    ) -> list[dict[RadarRotatingElevationBearingRange, tuple[Action, ...]]]:
        """The look to be made at `timestamp`, taken as made: call it once for every look.

        Args:
            tracks: the live tracks, as they are before the look.
            timestamp: time of the look.
            nchoose: number of configurations wanted; only one is known.
            **kwargs: not used.

        Raises:
            ValueError: if more than one configuration is wanted, or time does not pass.
        """
        if nchoose != 1:
            raise ValueError(f"nchoose = {nchoose}: expected 1")
        interval = self._interval(timestamp)
        self.slots = take_slots(self.slots, tracks)
        held = [
            None if track is None else (track.state, (NEVER, NO_DETECTION), NO_DETECTION)
            for track in self.slots
        ]
        place = np.asarray(self.radar.position, float).ravel()
        orientation = np.asarray(self.radar.orientation, float).ravel()
        look = self._decide(on_device(fill_slots(held, NEVER)), self.scan_map, self.step, place, orientation)
        generators = {one.attribute: one for one in self.radar.actions(timestamp)}
        actions = [
            nearest_action(generators[axis], float(angle)) for axis, angle in zip(AXES, look, strict=True)
        ]
        reached = np.array([float(action.target_value) for action in actions])
        self.scan_map = self._see(self.scan_map, reached, interval)
        self.step, self.last_time = self.step + 1, timestamp
        return [{self.radar: tuple(actions)}]

    def _interval(self, timestamp: datetime.datetime) -> float:
        """Time since the last look (s)."""
        if self.last_time is None:
            return self.params.time_step
        interval = (timestamp - self.last_time).total_seconds()
        if interval <= 0:
            raise ValueError(f"timestamp = {timestamp}: expected later than the last look, {self.last_time}")
        return interval

    def _look(
        self, tracks: Tracks, scan_map: jax.Array, step: jax.Array, place: jax.Array, orientation: jax.Array
    ) -> jax.Array:
        """Azimuth and elevation `[2]` (rad) that the policy wants."""
        state = EnvState(
            time=jnp.asarray(step),
            truths=Truths(
                state=jnp.zeros((self.static.num_truths, STATE_DIM)),
                alive=jnp.zeros(self.static.num_truths, bool),
            ),
            tracks=in_radar_frame(tracks, place, orientation),
            scan_map=scan_map,
            num_born=jnp.asarray(0),
            num_initiated=jnp.asarray(0),
        )
        return look_angles(self._policy(jax.random.key(self.seed), state), self.static, self.params)

    def _scan(self, scan_map: jax.Array, look: jax.Array, interval: float) -> jax.Array:
        """The map after a look."""
        return update_scan_map(scan_map, look, self.static, replace(self.params, time_step=interval))


def in_radar_frame(tracks: Tracks, place: jax.Array, orientation: jax.Array) -> Tracks:
    """The track list as seen from a radar at `place` `[3]` (m) with `orientation` `[3]` (rad)."""
    turn = jnp.kron(rotation(orientation), jnp.eye(2))
    return tracks.replace(
        mean=to_platform(tracks.mean, place, orientation), covariance=turn @ tracks.covariance @ turn.T
    )


def nearest_action(generator: ActionGenerator, angle: float) -> Action:
    """The action that turns an axis to the angle (rad), or as near to it as it can."""
    if isinstance(generator, RealNumberActionGenerator):
        action = generator.action_from_value(angle)
        if action is not None:
            return action
    return min(generator, key=lambda action: abs(float(Bearing(float(action.target_value) - angle))))


def build_agile_radar(params: Params, seed: int | None = None) -> RadarRotatingElevationBearingRange:
    """The stock rotating radar, quick enough to turn from one edge of the field to the other in a step.

    It is at rest at `components.EPOCH`, and tells angles to a hundredth of a milliradian.
    """
    radar = build_radar(params, RadarRotatingElevationBearingRange, seed)
    turns = 2 * params.field_limit / (2 * np.pi)
    radar.rpm = 1.1 * 60 * turns / params.time_step
    radar.resolution = Angle(1e-5)
    radar.timestamp = EPOCH
    return radar
