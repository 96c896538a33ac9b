"""Generalised advantage estimation with terminated and truncated told apart."""

import jax
import jax.numpy as jnp


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    done: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
    """Advantages `[S, B]` over S steps of B environments (Schulman et al. 2016, eq. 16).

    Args:
        reward: `[S, B]` reward of the step.
        value: `[S, B]` value of the observation before it.
        next_value: `[S, B]` value of the observation it led to; where the episode ended, of
            the final observation, not of the next episode's first one.
        terminated: `[S, B]` whether nothing follows: the next value then counts nothing.
        done: `[S, B]` terminated or truncated: the sum does not run on into the next episode.
        gamma: discount per step.
        gae_lambda: decay of the sum.
    """
    delta = reward + gamma * next_value * (1 - terminated) - value

    def accumulate(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_now, done_now = step
        advantage = delta_now + gamma * gae_lambda * (1 - done_now) * following
        return advantage, advantage

    _, result = jax.lax.scan(accumulate, jnp.zeros_like(delta[0]), (delta, done), reverse=True)
    return result
