"""Numbers from uniform draws."""

import jax
import jax.numpy as jnp

from jaxtrack.types import Scalar


def poisson_quantile(uniform: jax.Array, rate: Scalar, largest: int) -> jax.Array:
    """Poisson number `[]` of one uniform draw `[]` in [0, 1), cut off at `largest`; 0 at rate 0.

    `rate` must leave ``exp(-rate)`` above zero in float32: at most 80.
    """
    if not largest:
        return jnp.asarray(0)
    counts = jnp.arange(largest)
    rate = jnp.asarray(rate, dtype=float)
    # Terms rate^k / k! by a running product: no logarithm of a zero rate.
    terms = jnp.cumprod(jnp.where(counts == 0, jnp.exp(-rate), rate / jnp.maximum(counts, 1)))
    number = jnp.sum(uniform >= jnp.cumsum(terms))
    # Rounding of the last sums must not count anything where the rate is zero.
    return jnp.where(rate > 0, number, 0)
