"""A training on two devices is that on one: in a process of its own, as JAX counts its devices only once."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.config import TrainConfig
from train.devices import ALONE, with_devices
from train.learner import shuffled

ON_TWO_DEVICES = """
import dataclasses, sys
import jax, numpy as np
from jaxtrack import Params, StaticParams, cores
assert cores.use(2) == 2
from jaxtrack.env import SearchTrack
from train.config import TrainConfig
from train.loop import jit_training

static = StaticParams(num_truths=3, max_tracks=5, max_detections=3, map_size=36, num_looks=5)
params = Params(beam_azimuth=1.2, beam_elevation=0.6, max_steps_in_episode=7)
one = TrainConfig(encoder=sys.argv[1], num_envs=8, rollout_steps=6, num_minibatches=4, epochs=2, microbatch=3,
    warm_start_steps=48, total_steps=480, learning_rate=1e-3, devices=1, static=static, params=params)
env = SearchTrack(static)

def train(config):
    programs, shapes = jit_training(env, config)
    state = programs.init(jax.random.key(0), config.params)
    logged = []
    for _ in range(3):
        state, metrics = programs.step(state)
        logged.append(jax.device_get(metrics))
    return state, logged

(alone, told), (shared, also_told) = train(one), train(dataclasses.replace(one, devices=2))
assert len(shared.env.time.sharding.device_set) == 2
assert int(alone.env.tracks.active.sum()) > 0 and any(row["episodes"] for row in told)
near = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4)
exact = lambda a, b: np.testing.assert_array_equal(a, b)
jax.tree.map(near, shared.weights, alone.weights)
jax.tree.map(near, also_told, told)
exact(shared.env.time, alone.env.time)
"""


@pytest.mark.medium
@pytest.mark.parametrize("encoder", ["beams", "bigru"])
def test_two_devices_learn_what_one_learns(quick_code, encoder):
    flags = [f"--{name}={str(value).lower()}" for name, value in quick_code.items()]
    quickly = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": " ".join(flags)}
    done = subprocess.run(
        [sys.executable, "-c", ON_TWO_DEVICES, encoder],
        env=os.environ | quickly,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("environments", "steps", "minibatches", "group"), [(4, 6, 3, 1), (6, 4, 8, 2), (3, 2, 6, 3)]
)
def test_every_group_gives_every_minibatch_as_many_samples(environments, steps, minibatches, group):
    config = TrainConfig(num_envs=environments, rollout_steps=steps, num_minibatches=minibatches)
    assert config.group_size == group
    rows = np.asarray(shuffled(jax.random.key(1), config, ALONE))
    assert sorted(rows.ravel()) == list(range(environments * steps))
    groups = rows % environments // group
    for minibatch in groups:
        counts = np.bincount(minibatch, minlength=environments // group)
        assert len(set(counts)) == 1
    assert not np.array_equal(rows, shuffled(jax.random.key(2), config, ALONE))


def test_as_many_devices_as_can_share_equally(monkeypatch):
    config = TrainConfig(num_envs=12, rollout_steps=4, num_minibatches=2)
    for there, taken in ((1, 1), (3, 3), (5, 4), (16, 12)):
        monkeypatch.setattr(jax, "device_count", lambda there=there: there)
        assert with_devices(config).devices == taken
    # A minibatch of 24 samples is six pieces of 4.
    assert with_devices(dataclasses.replace(config, microbatch=4)).devices == 6
    fixed = dataclasses.replace(config, devices=2)
    assert with_devices(fixed) == fixed


def test_more_devices_than_there_are_is_an_error_that_says_how_to_have_them():
    config = TrainConfig(devices=64)
    with pytest.raises(ValueError, match=r"devices = 64: expected at most \d+, .*JAX_NUM_CPU_DEVICES=64"):
        with_devices(config)


def test_one_device_adds_up_nothing():
    rows = jnp.arange(4.0)
    for result in (ALONE.own(rows), ALONE.all(rows), ALONE.add(rows)):
        assert result is rows
