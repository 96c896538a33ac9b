"""The truths of the scenario in stock Stone Soup, with its own draws or with given ones."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.simulator.simple import MultiTargetGroundTruthSimulator
from stonesoup.types.array import StateVector
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.state import GaussianState

from jaxtrack.params import Params, StaticParams
from jaxtrack.types import STATE_DIM
from reference.components import EPOCH, step_duration, transition_model


@dataclass(frozen=True)
class Draws:
    """All that is random in one episode of K steps and N rows, in physical units.

    Attributes:
        initial: `[M, 6]` truths at the start.
        motion: `[K, N, 6]` what the white acceleration adds to the states.
        death: `[K, N]` uniform; at or below the death probability the truth ends.
        births: `[K]` number of truths born.
        newborn: `[K, N, 6]` their states.
        detection: `[K, N, 3]` noise of elevation, bearing (rad) and range (m).
    """

    initial: np.ndarray
    motion: np.ndarray
    death: np.ndarray
    births: np.ndarray
    newborn: np.ndarray
    detection: np.ndarray


class FieldTruths(MultiTargetGroundTruthSimulator):
    """The stock simulator; its newborns are placed by the scenario's law instead of a Gaussian."""

    newborn: Callable[[], np.ndarray] = Property(doc="Gives the state of a new truth.")

    def _new_target(
        self, time: object, random_state: object, state_vector: StateVector | None = None
    ) -> GroundTruthPath:
        if state_vector is None:
            state_vector = StateVector(self.newborn())
        return super()._new_target(time, random_state, state_vector)


class ScriptedTransition(CombinedLinearGaussianTransitionModel):
    """Constant velocity whose noise is given."""

    script: "Script" = Property(doc="Where the noise comes from.")

    def rvs(self, num_samples: int = 1, **kwargs: Any) -> StateVector:
        """The next displacement."""
        return StateVector(next(self.script.motion))


class Script:
    """Hands the draws of one step to the stock simulator, in the order in which it asks for them.

    It stands in for numpy's random state, for the noise of the transition model, and for the
    law of newborns.
    """

    def __init__(self, draws: Draws) -> None:
        self.draws = draws

    def begin(self, step: int, living: Sequence[int], num_born: int, death_probability: float) -> None:
        """Lays out one step.

        Args:
            step: index of the step, from 0.
            living: rows of the truths alive before it, in the simulator's order.
            num_born: rows used so far.
            death_probability: of the scenario.
        """
        draws, rows = self.draws, np.asarray(living, dtype=int)
        surviving = rows[draws.death[step, rows] > death_probability]
        free = draws.newborn.shape[1] - num_born
        self.uniform: Iterator[float] = iter(draws.death[step, rows])
        self.motion: Iterator[np.ndarray] = iter(draws.motion[step, surviving])
        self.births = min(int(draws.births[step]), free)
        self.newborns: Iterator[np.ndarray] = iter(draws.newborn[step, num_born:])

    def rand(self) -> float:
        """The simulator's draw for one death."""
        return next(self.uniform)

    def poisson(self, rate: float) -> int:
        """The simulator's draw for the number of births."""
        del rate
        return self.births

    def newborn(self) -> np.ndarray:
        """State of the next newborn."""
        return next(self.newborns)


def initial_states(rng: np.random.Generator, count: int, params: Params) -> np.ndarray:
    """Truths `[count, 6]`: uniform in azimuth, elevation and range, normal in velocity."""
    azimuth, elevation = rng.uniform(-params.field_limit, params.field_limit, (2, count))
    distance = rng.uniform(params.min_range, params.max_range, count)
    ground = distance * np.cos(elevation)
    states = np.empty((count, STATE_DIM))
    states[:, 0::2] = np.stack(
        [ground * np.cos(azimuth), ground * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
    states[:, 1::2] = params.truth_velocity_sigma * rng.standard_normal((count, 3))
    states[:, 1] -= params.platform_speed
    return states


def truth_simulator(states: np.ndarray, seed: int, params: Params) -> FieldTruths:
    """Truths for one episode that start at the given states `[M, 6]`, with Stone Soup's own draws."""
    rng = np.random.default_rng(seed)
    motion_seed, life_seed = (int(number) for number in rng.integers(2**31, size=2))
    return _simulator(
        states,
        params,
        transition_model=transition_model(params.truth_process_noise, motion_seed),
        newborn=lambda: initial_states(rng, 1, params)[0],
        seed=life_seed,
    )


def scripted_simulator(script: Script, params: Params) -> FieldTruths:
    """Truths for one episode with given draws."""
    parts = [ConstantVelocity(float(params.truth_process_noise))] * 3
    simulator = _simulator(
        script.draws.initial,
        params,
        transition_model=ScriptedTransition(parts, script=script),
        newborn=script.newborn,
    )
    simulator.random_state = script
    return simulator


def _simulator(states: np.ndarray, params: Params, **parts: Any) -> FieldTruths:
    for name in ("truth_turn_rate", "truth_acceleration", "platform_turn_rate", "trajectories"):
        if getattr(params, name) is not None:
            raise ValueError(f"{name}: expected None, these truths fly straight")
    return FieldTruths(
        initial_state=GaussianState(np.zeros(STATE_DIM), np.eye(STATE_DIM), timestamp=EPOCH),
        timestep=step_duration(params),
        number_steps=int(params.max_steps_in_episode) + 1,
        birth_rate=params.birth_rate,
        death_probability=params.death_probability,
        preexisting_states=[StateVector(state) for state in states],
        **parts,
    )


def num_initial(static: StaticParams, params: Params) -> int:
    """Truths alive at the start."""
    return static.num_truths if params.initial_truths is None else int(params.initial_truths)
