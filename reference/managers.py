"""Stone Soup's own sensor manager on our radar: every look is tried, the best is chosen.

Stock: `BruteForceSensorManager`, `UncertaintyRewardFunction`, predictor and updater. Ours: only
that the radar's two angles may take the values of the looks at once, where the stock action
generators turn at a rate.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.sensormanager import BruteForceSensorManager
from stonesoup.sensormanager.action import Action, ActionableProperty, ActionGenerator
from stonesoup.sensormanager.reward import UncertaintyRewardFunction
from stonesoup.types.array import StateVector

from jaxtrack.params import Params, StaticParams
from reference.components import build_components
from reference.radar import SteeredRadar, build_radar


class PointAction(Action):
    """Turns one axis of the boresight to an angle at once."""

    def act(self, *args: Any, **kwargs: Any) -> StateVector:
        """The new angle (rad)."""
        return StateVector([self.target_value])


class LookAngles(ActionGenerator):
    """Actions that turn one axis to each of the angles of the looks."""

    angles: np.ndarray = Property(doc="Angles of the looks (rad).")

    def __contains__(self, item: PointAction) -> bool:
        """Whether the action turns to the angle of a look."""
        return item.target_value in self.angles

    def __iter__(self) -> Iterator[PointAction]:
        """One action for each angle."""
        for angle in self.angles:
            yield self._action(angle)

    @property
    def default_action(self) -> PointAction:
        """Stays."""
        return self._action(self.current_value[0, 0])

    def _action(self, angle: float) -> PointAction:
        return PointAction(generator=self, end_time=self.end_time, target_value=angle)


class ManagedRadar(SteeredRadar):
    """The steered radar, whose sightline a sensor manager sets."""

    angles: np.ndarray = Property(default=None, doc="Angles of the looks along either axis (rad).")
    dwell_centre: StateVector = ActionableProperty(
        doc="Azimuth of the boresight (rad).",
        generator_cls=LookAngles,
        generator_kwargs_mapping={"angles": "angles"},
    )
    tilt_centre: StateVector = ActionableProperty(
        doc="Elevation of the boresight (rad).",
        generator_cls=LookAngles,
        generator_kwargs_mapping={"angles": "angles"},
    )


def build_manager(static: StaticParams, params: Params) -> BruteForceSensorManager:
    """The stock manager of one radar that offers all looks."""
    radar = build_radar(params, ManagedRadar)
    radar.angles = params.field_limit * np.linspace(-1, 1, static.num_looks)
    parts = build_components(params)
    return BruteForceSensorManager(
        sensors={radar}, reward_function=UncertaintyRewardFunction(parts.predictor, parts.updater)
    )


def look_of(config: dict[ManagedRadar, tuple[PointAction, ...]]) -> tuple[int, int]:
    """Azimuth and elevation index of the look that a configuration of the one radar stands for."""
    ((radar, actions),) = config.items()
    angle = {action.generator.attribute: action.target_value for action in actions}
    azimuth, elevation = (
        np.abs(radar.angles - angle[axis]).argmin() for axis in ("dwell_centre", "tilt_centre")
    )
    return int(azimuth), int(elevation)
