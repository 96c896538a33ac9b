"""Stable-Baselines3's own checker on the Stone Soup environment; `make sb3` installs what it needs."""

import pytest

from jaxtrack import Params, StaticParams
from reference.gym_env import StoneSoupEnv

pytestmark = pytest.mark.sb3

# The paper's observation is a list and a map, for which it has its own feature extractor.
ADVICE = "ignore:.*has an unconventional shape:UserWarning"


@pytest.mark.filterwarnings(ADVICE)
def test_the_checker_of_stable_baselines3():
    from stable_baselines3.common.env_checker import check_env

    shapes = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=7)
    check_env(StoneSoupEnv(shapes, Params(max_steps_in_episode=20)))
