"""The Stone Soup environment, and its observation against `jaxtrack.observation` and `scan_map`."""

import itertools

import jax
import numpy as np
import pytest
from stonesoup.types.groundtruth import GroundTruthState

from jaxtrack import Params, StaticParams, observation, scan_map
from jaxtrack.sensor import look_angles
from reference import observation as observation_module
from reference.components import EPOCH
from reference.observation import TrackSlots
from reference.parity.scenes import spherical
from reference.radar import build_radar
from reference.reward import track_term
from reference.simulation import StoneSoupScenario
from reference.translate import as_vector, to_tracks, track_key
from reference.truths import initial_states, num_initial, truth_simulator

pytestmark = pytest.mark.usefixtures("quick_compilation")

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


def test_truths_start_in_the_field(params):
    states = initial_states(np.random.default_rng(0), 4000, params)
    elevation, azimuth, distance = spherical(states[:, 0::2]).T
    for angle in (azimuth, elevation):
        assert 0.99 * params.field_limit < np.abs(angle).max() <= params.field_limit
        np.testing.assert_allclose(angle.std(), params.field_limit / np.sqrt(3), rtol=0.05)
    assert params.min_range <= distance.min() < 1.02 * params.min_range
    assert 0.99 * params.max_range < distance.max() <= params.max_range
    np.testing.assert_allclose(states[:, 1::2].std(axis=0), params.truth_velocity_sigma, rtol=0.05)


def test_truths_of_its_own_are_born_die_and_move_as_asked():
    numbers = {"initial_truths": 2, "process_noise": 1e9, "time_step": 1.0}
    assert num_initial(STATIC, Params(**numbers)) == 2
    assert num_initial(STATIC, Params()) == STATIC.num_truths
    state = np.array([[3000.0, 10, 0, -5, 0, 0]])

    def after(steps, **more):
        params = Params(**numbers, truth_process_noise=0.0, **more)
        for _, paths in itertools.islice(truth_simulator(state, 7, params), steps + 1):
            living = list(paths)
        return living

    (straight,) = after(3)
    np.testing.assert_allclose(as_vector(straight[-1].state_vector), [3030.0, 10, -15, -5, 0, 0])
    assert 10 < len(after(10, birth_rate=2.0)) < 40
    assert after(10, death_probability=1.0) == []


def test_the_noise_of_the_radar_follows_its_seed(params):
    truth = GroundTruthState(np.array([3000.0, 0, 0, 0, 0, 0]), timestamp=EPOCH)
    values = [
        as_vector(found.state_vector)
        for seed in (1, 1, 2)
        for found in build_radar(params, seed=seed).measure({truth})
    ]
    np.testing.assert_array_equal(values[0], values[1])
    assert np.all(values[0] != values[2])


@pytest.mark.parametrize(("living", "worst"), [(0, 100.0), (2, 200.0), (8, 800.0)])
def test_the_reward_of_that_name_is_gospa_beside_that_without_tracks(living, worst):
    static, params = StaticParams(reward="gospa"), Params(gospa_order=1.0)
    assert track_term({}, {}, 50.0, living, static, params) == pytest.approx(1 - 50.0 / worst)


def test_a_track_without_a_slot_waits_for_the_first_free_one(monkeypatch):
    monkeypatch.setattr(observation_module, "track_key", lambda track: track)
    slots = TrackSlots(3)
    for live, held in (
        ({2, 1, 3, 4}, [1, 2, 3]),
        ({1, 3, 4}, [1, 4, 3]),
        ({3, 5}, [5, None, 3]),
        ({3, 5, 7, 6, 8}, [5, 6, 3]),
    ):
        slots.update(live)
        assert slots.tracks == held


@pytest.mark.parametrize("numbers", [{"clutter_rate": 1.0}, {"detection_probability": 0.5}])
def test_what_it_does_not_simulate_is_refused(numbers):
    with pytest.raises(ValueError, match="clutter_rate = 0"):
        StoneSoupScenario(STATIC, Params(**numbers))
