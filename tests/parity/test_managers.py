"""Our managers against Stone Soup's `BruteForceSensorManager` with its `UncertaintyRewardFunction`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.episode import EnvState
from jaxtrack.managers import expected_falls, uncertainty
from jaxtrack.scan_map import initial_scan_map, look_grid
from jaxtrack.types import Truths
from reference.components import time_of
from reference.managers import build_manager, look_of
from reference.parity.scenes import AHEAD, random_tracks
from reference.translate import to_stone_soup_tracks

STATIC = StaticParams(num_looks=7, max_tracks=8, num_truths=1)
PARAMS = Params(beam_azimuth=0.5, beam_elevation=0.4, time_step=0.25)
LOOKS = look_grid(STATIC, PARAMS)
STEP = 4
FALLS = jax.jit(lambda tracks: expected_falls(tracks, LOOKS, PARAMS))
CHOOSE = jax.jit(uncertainty(STATIC, PARAMS))


def scene(seed):
    """Five tracks all over the field, three empty slots."""
    return random_tracks(np.random.default_rng(seed), 5, AHEAD, STATIC.max_tracks, spread=0.35)


@pytest.mark.parametrize("seed", range(4))
def test_every_look_has_the_same_value_and_the_same_one_is_chosen(seed):
    tracks = scene(seed)
    manager = build_manager(STATIC, PARAMS)
    theirs_tracks = to_stone_soup_tracks(tracks, time_of(STEP, PARAMS))
    when = time_of(STEP + 1, PARAMS)
    configs, rewards = manager.choose_actions(theirs_tracks, when, nchoose=49, return_reward=True)
    theirs = np.full((7, 7), np.nan)
    for config, reward in zip(configs, rewards, strict=True):
        theirs[look_of(config)] = reward
    ours = np.asarray(FALLS(tracks)).reshape(7, 7)
    assert np.count_nonzero(theirs) >= 5
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * theirs.max())

    ((best,),) = (manager.choose_actions(theirs_tracks, when),)
    truths = Truths(state=jnp.zeros((1, 6)), alive=jnp.ones(1, bool))
    scan_map = initial_scan_map(STATIC)
    state = EnvState(jnp.asarray(STEP), truths, tracks, scan_map, jnp.asarray(1), jnp.asarray(5))
    action = tuple(CHOOSE(jax.random.key(0), state).tolist())
    # Several looks may hold the same tracks: which of them is chosen depends on their order.
    assert theirs[look_of(best)] == theirs.max()
    np.testing.assert_allclose(theirs[action], theirs.max(), rtol=1e-9)
    if np.sum(theirs > theirs.max() * (1 - 1e-9)) == 1:
        assert action == look_of(best)
