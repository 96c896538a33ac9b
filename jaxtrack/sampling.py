"""Random numbers, and choices among rows."""

import jax
import jax.numpy as jnp

from jaxtrack.kernel import one_by_one, stage
from jaxtrack.types import Scalar

_LANES = 16
"""Numbers a CPU works on at once: a draw of a multiple of them needs no slower rest."""


def draw(key: jax.Array, num_normal: int, num_uniform: int) -> tuple[jax.Array, jax.Array]:
    """Standard normal numbers and numbers uniform in (0, 1), in one long draw; the key is consumed."""
    length = -(-(num_normal + num_uniform) // _LANES) * _LANES
    numbers = jnp.concatenate(stage(lambda key: _symmetric_uniform(key, length))(key))
    normal = stage(lambda uniform: jnp.sqrt(2.0).astype(uniform.dtype) * jax.lax.erf_inv(uniform))
    return normal(numbers[:num_normal]), (numbers[num_normal : num_normal + num_uniform] + 1) / 2


def split(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two new keys, as `jax.random.split`, which for a batch takes many kernels; the key is consumed."""
    return one_by_one(lambda key: tuple(jax.random.split(key)))(key)


def draw_index(key: jax.Array, time: jax.Array, number: int) -> jax.Array:
    """Uniform index `[]` below `number`, another one at every time (steps) with the same key."""

    def one(key: jax.Array, time: jax.Array) -> jax.Array:
        return jax.random.randint(jax.random.fold_in(key, time), (), 0, number)

    return one_by_one(one)(key, time)


def _symmetric_uniform(key: jax.Array, length: int) -> list[jax.Array]:
    """Uniform in (-1, 1), where the normal distribution's quantile is finite: parts of `length` in all."""
    if jnp.ones(()).dtype == jnp.float64:
        return [_middle_of_cell(jax.random.bits(key, (length,), jnp.uint64))]
    # A new key is two random words. `jax.random.bits` works out as much for each word that it returns.
    words = jax.random.key_data(jax.random.split(key, length // 2))
    return [_middle_of_cell(words[:, 0]), _middle_of_cell(words[:, 1])]


def _middle_of_cell(bits: jax.Array) -> jax.Array:
    """The middle of one of 2^23 (of 64 bits: 2^52) equal cells of (-1, 1).

    Exact, and so is its place in (0, 1), half of it and a half: neither is ever an end of its interval.
    """
    kind, signed = (jnp.float32, jnp.int32) if bits.dtype == jnp.uint32 else (jnp.float64, jnp.int64)
    unused = jnp.finfo(kind).bits - jnp.finfo(kind).nmant
    cell = jax.lax.bitcast_convert_type(bits, signed) >> unused
    return (cell.astype(kind) + 0.5) * 2.0 ** (1 - jnp.finfo(kind).nmant)


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


def first_largest(values: jax.Array) -> jax.Array:
    """Index `[]` of the largest of `values` `[R]`, the first of equals; 0 if one is NaN.

    As `jnp.argmax`, which a CPU works out number by number.
    """
    rows = jnp.arange(values.shape[0])
    return jnp.min(jnp.where(values < jnp.max(values), rows.size, rows))


def places(chosen: jax.Array) -> jax.Array:
    """`[R]` how many rows before each one are chosen `[R]`: the place of a chosen row among them."""
    rows = jnp.arange(chosen.shape[0])
    return jnp.sum(chosen & (rows < rows[:, None]), axis=1)


def matches(takers: jax.Array, taken: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Gives the k-th chosen row of `taken` `[S]` to the k-th chosen row of `takers` `[R]`.

    Returns:
        `[R]` whether the taker gets a row, and `[R]` which one (0 if none).
    """
    pairs = takers[:, None] & taken & (places(takers)[:, None] == places(taken))
    return jnp.any(pairs, axis=1), jnp.argmax(pairs, axis=1)
