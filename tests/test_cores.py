"""Scenarios shared out among cores: in a process of its own, as JAX counts its devices only once."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxtrack import cores

ON_TWO_CORES = """
import jax, jaxtrack, numpy as np
from jaxtrack import cores
assert cores.use(2) == 2 == len(jax.devices())
env, params = jaxtrack.make(num_truths=3, max_tracks=5, map_size=12, beam_azimuth=2.0, beam_elevation=1.0)
keys = jax.random.split(jax.random.key(0), 4)

def play(keys, params):
    states = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)[1]
    action = jax.numpy.array([9, 9])
    return jax.vmap(env.step, in_axes=(0, 0, None, None))(keys, states, action, params)

together = jax.jit(play)(keys, params)
shared = jax.jit(cores.share_out(play, shared=1))(keys, params)
assert len(jax.tree.leaves(shared)[0].sharding.device_set) == 2
assert int(shared[5]["num_detections"].sum()) > 0
jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-4), shared, together)
"""


@pytest.mark.medium
def test_two_cores_give_what_one_gives(quick_code):
    flags = [f"--{name}={str(value).lower()}" for name, value in quick_code.items()]
    quickly = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": " ".join(flags)}
    done = subprocess.run(
        [sys.executable, "-c", ON_TWO_CORES],
        env=os.environ | quickly,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_on_one_device_nothing_is_shared():
    doubled = cores.share_out(lambda x, y: {"twice": 2 * x + y}, shared=1)
    assert doubled(jnp.arange(3), jnp.asarray(1))["twice"].tolist() == [1, 3, 5]


def test_rows_that_can_not_be_shared_are_refused(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    with pytest.raises(ValueError, match=r"rows = \[3\]: expected one multiple of the number of devices, 2"):
        cores.share_out(jnp.sin)(jnp.zeros(3))


def test_after_the_start_of_jax_nothing_changes():
    before = jnp.zeros(1).sharding.num_devices * jax.device_count()
    assert cores.use(7) == before
