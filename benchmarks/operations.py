"""Our side of `benchmarks.tracker`: three operations, each compiled for one scenario and for many."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.scene import STEP, Estimates, Scene, from_tracks, in_order
from jaxtrack import kalman, tracker
from jaxtrack.kernel import one_by_one
from jaxtrack.params import Params
from jaxtrack.types import Detections, Tracks


def predict(scene: Scene, params: Params) -> Tracks:
    """Ours of `KalmanPredictor`."""
    return kalman.predict(scene.tracks, params.time_step, params)


def update(scene: Scene, params: Params) -> Tracks:
    """Ours of `UnscentedKalmanUpdater`: every track with its own detection."""
    expected = kalman.predict_detections(scene.predicted, params)
    own = jnp.arange(scene.own.shape[0])
    return kalman.update(scene.predicted, expected, Detections.from_values(scene.own), own)


def step(scene: Scene, params: Params) -> Tracks:
    """Ours of `MultiTargetTracker`."""
    detections = Detections.from_values(scene.scan)
    return tracker.step(scene.tracks, detections, params.time_step, jnp.asarray(STEP), params)[0]


Operation = Callable[[Scene, Params], Tracks]

OPERATIONS: dict[str, Operation] = {"predict": predict, "update": update, "step": step}
"""What is timed, ours; the peers have methods of the same names."""


class Ours:
    """One operation compiled for one scenario and for a batch of them.

    Args:
        operation: one of `OPERATIONS`.
        scenes: at least `batch` scenarios; they are cast to JAX's present precision.
        batch: how many of them are done together.
        params: numbers of the tracker.

    Attributes:
        compile_seconds: what compiling both took (s).
    """

    def __init__(self, operation: str, scenes: Scene, batch: int, params: Params) -> None:
        # As in the environment: a batch is done one scenario after the other in one kernel.
        together = jax.vmap(one_by_one(OPERATIONS[operation]), in_axes=(0, None))
        self.whole_step, self.params = operation == "step", params
        self.scenes: Scene = jax.tree.map(jnp.asarray, scenes)
        self.few: Scene = jax.tree.map(lambda leaf: leaf[:batch], self.scenes)
        began = time.perf_counter()
        self.one = jax.jit(OPERATIONS[operation]).lower(self.scene(0), params).compile()
        self.all = jax.jit(together).lower(self.few, params).compile()
        self.compile_seconds = time.perf_counter() - began
        jax.block_until_ready((self.one(self.scene(0), params), self.all(self.few, params)))

    def scene(self, place: int) -> Scene:
        """One of the scenarios."""
        return jax.tree.map(lambda leaf: leaf[place], self.scenes)

    def result(self, place: int) -> Estimates:
        """What it makes of one scenario."""
        tracks = self.one(self.scene(place), self.params)
        return from_tracks(tracks) if self.whole_step else in_order(tracks.mean, tracks.covariance)

    def time(self, place: int, min_seconds: float) -> tuple[float, float]:
        """Seconds for one scenario by itself, and for one of a batch."""
        one, size = jax.block_until_ready(self.scene(place)), self.few.own.shape[0]
        alone = mean_seconds(lambda: self.one(one, self.params), min_seconds)
        return alone, mean_seconds(lambda: self.all(self.few, self.params), min_seconds) / size


def mean_seconds(call: Callable[[], Any], min_seconds: float) -> float:
    """Seconds of one call, which is made again and again for at least so long (s)."""
    calls, began = 0, time.perf_counter()
    while (seconds := time.perf_counter() - began) < min_seconds or not calls:
        jax.block_until_ready(call())
        calls += 1
    return seconds / calls
