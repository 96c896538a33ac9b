"""Tiny environments of which everything is known (probes, as in rejax), and an agent for them."""

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from jaxtrack import StaticParams
from train.rollout import LOGGED

LOOKS = 2


class ProbeState(struct.PyTreeNode):
    """Steps since the start, and a coin that the observation shows."""

    time: jax.Array
    coin: jax.Array


class Probe:
    """Reward is a function of (time, coin, action); the observation is time and coin, one-hot."""

    static = StaticParams()

    def __init__(self, reward, length, terminates=False):
        self.reward, self.length, self.terminates = reward, length, terminates

    def observe(self, state):
        return jnp.concatenate([jax.nn.one_hot(state.time, self.length + 1), jax.nn.one_hot(state.coin, 2)])

    def reset_env(self, key, params):
        coin = jax.random.bernoulli(key).astype(int)
        state = ProbeState(time=jnp.asarray(0), coin=coin)
        return self.observe(state), state

    def step(self, key, state, action, params):
        key_coin, key_reset = jax.random.split(key)
        reward = self.reward(state.time, state.coin, action).astype(float)
        after = ProbeState(state.time + 1, jax.random.bernoulli(key_coin).astype(int))
        end = after.time == self.length
        final, (_, first) = self.observe(after), self.reset_env(key_reset, params)
        state = jax.tree.map(lambda new, old: jnp.where(end, new, old), first, after)
        info = {"final_observation": final, **{name: reward for name in LOGGED}}
        terminated, truncated = end & self.terminates, end & (not self.terminates)
        return self.observe(state), state, reward, terminated, truncated, info


class Linear(nn.Module):
    """Logits of all looks and a value, both linear in the observation."""

    @nn.compact
    def __call__(self, inputs):
        logits = nn.Dense(LOOKS**2, use_bias=False, name="logits", kernel_init=nn.initializers.zeros)(inputs)
        value = nn.Dense(1, use_bias=False, name="value", kernel_init=nn.initializers.normal(0.1))(inputs)
        return logits, value[..., 0]


def constant(time, coin, action):
    return jnp.ones(())


def right_look(time, coin, action):
    """1 for look (1, 0) while the coin shows 1, for look (0, 1) while it shows 0."""
    return jnp.where(coin == 1, (action == jnp.array([1, 0])).all(), (action == jnp.array([0, 1])).all())


def at_the_end(time, coin, action):
    return jnp.where(time == 2, 1.0, 0.0)
