"""Our policies as Stone Soup's sensor manager, against the same policies in our environment."""

import datetime
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.sensor.radar.radar import RadarElevationBearingRange

from jaxtrack import Params, StaticParams, policies
from jaxtrack.beam_means import beam_means
from jaxtrack.env import SearchTrack
from jaxtrack.platform import from_platform, rotation
from jaxtrack.policies import POLICIES
from reference.components import EPOCH, noise_covariance, time_of
from reference.managers import ManagedRadar
from reference.parity.environment import Played, draws_of
from reference.parity.scenes import AHEAD, random_tracks
from reference.policy_manager import PolicyManager, build_agile_radar, in_radar_frame
from reference.radar import build_radar
from reference.simulation import StoneSoupScenario
from reference.translate import to_stone_soup_tracks

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=6, max_tracks=8, max_detections=10, map_size=24, num_looks=9)
PARAMS = Params(
    time_step=0.04,
    field_limit=0.35,
    truth_velocity_sigma=20.0,
    deletion_threshold=3000.0,
    initial_truths=6,
    death_probability=0.003,
)
STEPS = 120


def by_slots(static, params):
    """Reads all that a policy may: one slot after another, the map where it is empty, the key, the time."""
    scan_values = beam_means(static, params)

    def policy(key, state):
        slot = state.time % static.max_tracks
        at_track = policies.nearest_look(state.tracks.mean[slot], static, params)
        anywhere = jax.random.randint(jax.random.fold_in(key, state.time), (), 0, static.num_looks**2)
        stalest = jnp.argmax(scan_values(state.scan_map))
        elsewhere = jnp.where(state.time % 3 == 0, anywhere, stalest)
        return policies.to_action(jnp.where(state.tracks.active[slot], at_track, elsewhere), static, params)

    return policy


def play_ours(build, seed):
    """One episode of our environment with the key of a manager's policy, and the final track list."""
    env, policy = SearchTrack(STATIC), build(STATIC, PARAMS)

    def step(state, key):
        noise = env.sample_noise(key)
        after, record = env.advance(state, policy(jax.random.key(seed), state), noise, PARAMS)
        return after, (after.truths, noise, record.look, after.tracks)

    @jax.jit
    def play(key):
        _, start = env.reset_env(key, PARAMS)
        return start.truths, jax.lax.scan(step, start, jax.random.split(key, STEPS))[1]

    initial, (truths, noise, looks, tracks) = jax.device_get(play(jax.random.key(1)))
    return Played(initial, truths, noise, looks, {}, {}), tracks


def pointing_radar():
    """The radar whose angles may be those of the looks at once."""
    radar = build_radar(PARAMS, ManagedRadar)
    radar.angles = PARAMS.field_limit * (2 * np.arange(STATIC.num_looks) / (STATIC.num_looks - 1) - 1)
    radar.timestamp = EPOCH
    return radar


def look_by(manager, tracks, time):
    """Where the radar points after the manager's actions."""
    ((config,), radar) = (manager.choose_actions(tracks, time), manager.radar)
    radar.add_actions(config[radar])
    radar.act(time)
    return np.array([radar.dwell_centre[0, 0], radar.tilt_centre[0, 0]], float)


@pytest.mark.parametrize("build", [by_slots, POLICIES["index"]])
def test_a_whole_episode_has_the_same_looks_as_in_our_environment(build):
    """Truths and tracker are Stone Soup's, with our draws; in one, tracks die and slots are used again."""
    played, tracks = play_ours(build, seed=5)
    scenario = StoneSoupScenario(STATIC, PARAMS, exact_jacobian=True)
    scenario.reset(draws=draws_of(played, PARAMS))
    manager = PolicyManager(build, STATIC, PARAMS, seed=5, sensors={pointing_radar()})
    looks = []
    for step in range(1, STEPS + 1):
        looks.append(look_by(manager, scenario.tracks, time_of(step, PARAMS)))
        scenario.step(*looks[-1])
    np.testing.assert_allclose(looks, played.actions, atol=1e-12)
    assert len(np.unique(tracks.birth_step[tracks.active])) > 3
    assert len(np.unique(looks, axis=0)) > 20
    if build is by_slots:
        assert np.any(tracks.active[:-1] & ~tracks.active[1:])
        first_step = np.where(tracks.active, tracks.birth_step, STEPS).min(axis=0)
        assert np.any(tracks.active & (tracks.birth_step > first_step))


def scene(seed=0):
    return random_tracks(np.random.default_rng(seed), 5, AHEAD, STATIC.max_tracks, spread=0.2)


def test_the_stock_radar_turns_where_the_policy_looks():
    manager = PolicyManager(by_slots, STATIC, PARAMS, seed=2, sensors={build_agile_radar(PARAMS)})
    exact = PolicyManager(by_slots, STATIC, PARAMS, seed=2, sensors={pointing_radar()})
    tracks = to_stone_soup_tracks(scene(), EPOCH)
    for step in range(1, 40):
        time = time_of(step, PARAMS)
        turned, wanted = look_by(manager, tracks, time), look_by(exact, tracks, time)
        np.testing.assert_allclose(turned, wanted, atol=3e-4)
    assert len(exact.slots) == STATIC.max_tracks


def test_a_slow_radar_goes_as_far_as_it_can_and_the_map_knows():
    """One turn a minute is 0.24 degrees in a step: 0.2 degrees at a resolution of 0.1."""
    radar = build_agile_radar(PARAMS)
    radar.rpm, radar.resolution = 1.0, np.radians(0.1)
    manager = PolicyManager(POLICIES["coverage"], STATIC, PARAMS, sensors={radar})
    look = look_by(manager, set(), time_of(1, PARAMS))
    np.testing.assert_allclose(np.degrees(look), -0.2, atol=0.05)
    columns = np.flatnonzero(np.any(np.asarray(manager.scan_map) == 0, axis=0))
    angles = PARAMS.field_limit * np.linspace(-1, 1, STATIC.map_size)[columns]
    assert abs(angles.mean()) < 0.02
    assert len(columns) > 3


def test_a_radar_elsewhere_looks_at_the_same_things():
    place, orientation = np.array([500.0, -200, 30]), np.array([0.1, -0.2, 2.0])
    tracks = scene(3)
    turn = np.kron(np.asarray(rotation(jnp.asarray(orientation))), np.eye(2))
    away = tracks.replace(
        mean=from_platform(tracks.mean, jnp.asarray(place), jnp.asarray(orientation)),
        covariance=turn.T @ tracks.covariance @ turn,
    )
    back = in_radar_frame(away, jnp.asarray(place), jnp.asarray(orientation))
    live = np.asarray(tracks.active)
    np.testing.assert_allclose(back.mean[live], tracks.mean[live], atol=1e-8)
    np.testing.assert_allclose(back.covariance[live], tracks.covariance[live], atol=1e-8)

    radar = build_radar(PARAMS, ManagedRadar, place=tuple(place), orientation=tuple(orientation))
    radar.angles, radar.timestamp = pointing_radar().angles, EPOCH
    only_tracks = partial(policies.index, scan_weight=0.0)
    looks = [
        look_by(
            PolicyManager(only_tracks, STATIC, PARAMS, sensors={one}),
            to_stone_soup_tracks(seen, EPOCH),
            time_of(1, PARAMS),
        )
        for one, seen in ((pointing_radar(), tracks), (radar, away))
    ]
    np.testing.assert_array_equal(looks[0], looks[1])
    assert np.any(looks[0] != radar.angles[0])  # look 0 is the answer where no track is seen


def test_the_map_ages_by_the_time_that_passed():
    manager = PolicyManager(POLICIES["coverage"], STATIC, PARAMS, sensors={pointing_radar()})
    manager.choose_actions(set(), time_of(1, PARAMS))
    seen = np.asarray(manager.scan_map) == 0
    assert seen.any()
    manager.choose_actions(set(), time_of(11, PARAMS))
    manager.choose_actions(set(), time_of(26, PARAMS))
    aged = np.asarray(manager.scan_map)[seen]
    expected = 1 - np.exp(-25 * PARAMS.time_step / PARAMS.scan_time_constant)
    assert np.max(aged) == pytest.approx(expected, rel=1e-9)


def test_after_a_reset_everything_is_as_at_the_start():
    manager = PolicyManager(by_slots, STATIC, PARAMS, sensors={pointing_radar()})
    tracks = to_stone_soup_tracks(scene(), EPOCH)
    times = [time_of(step, PARAMS) for step in range(1, 12)]
    first = [look_by(manager, tracks, time) for time in times]
    manager.reset()
    manager.radar.timestamp = EPOCH
    np.testing.assert_array_equal([look_by(manager, tracks, time) for time in times], first)


def test_wrong_use_is_refused():
    build, radar = POLICIES["index"], pointing_radar()
    with pytest.raises(ValueError, match=r"^sensors: 0 of them; expected one radar$"):
        PolicyManager(build, STATIC, PARAMS)
    with pytest.raises(ValueError, match=r"^sensors: 2 of them; expected one radar$"):
        PolicyManager(build, STATIC, PARAMS, sensors={radar, pointing_radar()})
    fixed = RadarElevationBearingRange(
        ndim_state=6, position_mapping=(0, 2, 4), noise_covar=noise_covariance(PARAMS)
    )
    named = "^sensors: RadarElevationBearingRange without dwell_centre and tilt_centre"
    with pytest.raises(ValueError, match=named):
        PolicyManager(build, STATIC, PARAMS, sensors={fixed})
    with pytest.raises(ValueError, match="range_sigma = -1"):
        PolicyManager(build, STATIC, PARAMS.replace(range_sigma=-1.0), sensors={radar})
    manager = PolicyManager(POLICIES["coverage"], STATIC, PARAMS, sensors={radar})
    with pytest.raises(ValueError, match=r"^nchoose = 2: expected 1$"):
        manager.choose_actions(set(), time_of(1, PARAMS), nchoose=2)
    manager.choose_actions(set(), time_of(1, PARAMS))
    with pytest.raises(ValueError, match=r"^timestamp = .*: expected later than the last look, "):
        manager.choose_actions(set(), time_of(1, PARAMS) - datetime.timedelta(seconds=1))
