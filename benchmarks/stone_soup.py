"""Stone Soup's side of the benchmarks: the same looks by the same rules, and the loop over steps."""

from collections.abc import Callable, Sequence

import numpy as np

from reference.simulation import StoneSoupScenario
from reference.translate import as_vector

Look = Callable[[StoneSoupScenario, np.random.Generator], Sequence[int] | np.ndarray]
"""Azimuth and elevation index of Stone Soup's next look."""


def raster_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> Sequence[int]:
    """As `jaxtrack.policies.coverage`."""
    del rng
    count = scenario.static.num_looks
    line, place = divmod(scenario.step_index, count)
    return place if line % 2 == 0 else count - 1 - place, line % count


def random_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> np.ndarray:
    """As `jaxtrack.policies.random`."""
    return rng.integers(scenario.static.num_looks, size=2)


def pointing_look(scenario: StoneSoupScenario, rng: np.random.Generator) -> np.ndarray:
    """As `benchmarks.playing.pointing`."""
    del rng
    truth = scenario.paths[scenario.step_index % len(scenario.paths)][-1]
    x, _, y, _, z, _ = as_vector(truth.state_vector)
    angles = np.array([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    last = scenario.static.num_looks - 1
    return np.clip(np.round((angles / scenario.params.field_limit + 1) / 2 * last), 0, last)


def play_stone_soup(
    scenario: StoneSoupScenario, look: Look, steps: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Steps the scenario; mean number of detections and of live tracks."""
    detections = live_tracks = 0.0
    for _ in range(steps):
        index = np.asarray(look(scenario, rng))
        azimuth, elevation = scenario.params.field_limit * (2 * index / (scenario.static.num_looks - 1) - 1)
        _, info = scenario.step(azimuth, elevation)
        detections += info["num_detections"]
        live_tracks += info["live_tracks"]
    return detections / steps, live_tracks / steps
