"""The Stone Soup environment, and its observation against `jaxtrack.observation` and `scan_map`."""

import jax
import numpy as np
import pytest

from jaxtrack import Params, StaticParams, observation, scan_map
from jaxtrack.sensor import look_angles
from reference.simulation import StoneSoupScenario
from reference.translate import as_vector, to_tracks, track_key

STATIC = StaticParams(num_truths=6, max_tracks=9, map_size=24)
UPDATE_MAP = jax.jit(scan_map.update_scan_map, static_argnums=2)


def boustrophedon(params):
    """Looks in rows, forward and back."""
    for row in range(STATIC.num_looks):
        for column in range(STATIC.num_looks):
            index = column if row % 2 == 0 else STATIC.num_looks - 1 - column
            yield np.asarray(look_angles(np.array([index, row]), STATIC, params))


def test_observation_over_one_raster():
    params = Params()
    scenario = StoneSoupScenario(STATIC, params)
    assert not scenario.reset(seed=1)["mask"].any()
    ours = scan_map.initial_scan_map(STATIC)
    found = 0
    for step, look in enumerate(boustrophedon(params), start=1):
        theirs, info = scenario.step(*look)
        ours = UPDATE_MAP(ours, look, STATIC, params)
        np.testing.assert_allclose(theirs["scan_map"], ours, atol=1e-12)
        found = max(found, info["live_tracks"])
        if step % 40 == 0:
            check_observation(scenario, theirs, step, params)
    assert found >= 4


def check_observation(scenario, theirs, step, params):
    tracks = to_tracks(scenario.tracks, step, STATIC.max_tracks, {})
    ours = observation.observe(tracks, theirs["scan_map"], params)
    held = [(slot, track) for slot, track in enumerate(scenario.slots.tracks) if track is not None]
    slots = [slot for slot, _ in sorted(held, key=lambda pair: track_key(pair[1]))]
    assert len(slots) == ours["mask"].sum() == theirs["mask"].sum()
    np.testing.assert_allclose(theirs["tracks"][slots], ours["tracks"][: len(slots)], atol=1e-12)


def test_tracks_are_where_truths_are():
    """Pointing at one truth for long gives one track on it."""
    params = Params()
    scenario = StoneSoupScenario(STATIC, params)
    scenario.reset(seed=2)
    x, _, y, _, z, _ = truth = first_truth(scenario)
    for _ in range(100):
        _, info = scenario.step(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))
    truth = first_truth(scenario)
    nearest = min(np.linalg.norm((as_vector(t.state_vector) - truth)[0::2]) for t in scenario.tracks)
    assert nearest < 20.0
    assert info["covariance_norm_sum"] > 0.0


def first_truth(scenario):
    return as_vector(scenario.paths[0][-1].state_vector)


def test_same_seed_same_episode():
    params = Params()
    first, second, other = (StoneSoupScenario(STATIC, params) for _ in range(3))
    runs = [scenario.reset(seed) for scenario, seed in ((first, 3), (second, 3), (other, 4))]
    for look in list(boustrophedon(params))[150:210]:
        runs = [scenario.step(*look)[0]["tracks"] for scenario in (first, second, other)]
    norms = [sorted(run[:, 6]) for run in runs]
    assert max(norms[0]) > 0
    np.testing.assert_array_equal(norms[0], norms[1])
    assert norms[0] != norms[2]


def test_episode_ends():
    params = Params(max_steps_in_episode=3)
    scenario = StoneSoupScenario(STATIC, params)
    scenario.reset(seed=5)
    for _ in range(3):
        scenario.step(0.0, 0.0)
    with pytest.raises(StopIteration):
        scenario.step(0.0, 0.0)


@pytest.mark.parametrize("numbers", [{"clutter_rate": 1.0}, {"detection_probability": 0.5}])
def test_what_it_does_not_simulate_is_refused(numbers):
    with pytest.raises(ValueError, match="clutter_rate = 0"):
        StoneSoupScenario(STATIC, Params(**numbers))
