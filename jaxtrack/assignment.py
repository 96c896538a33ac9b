"""Assignment of rows to columns at the least total cost, exactly: shortest augmenting paths.

R. Jonker, A. Volgenant, "A shortest augmenting path algorithm for dense and sparse linear
assignment problems", Computing 38 (1987). Nothing in it keeps it out of a single CPU kernel
(`jaxtrack.kernel`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

NOBODY = -1
"""In place of a row or a column: there is none."""


class _Matching(NamedTuple):
    """A cheapest assignment of some rows.

    The column of an assigned row is the cheapest for it, cost less price. Prices are at most 0,
    and 0 for a column without a row.
    """

    column: jax.Array  # [N] or NOBODY
    row: jax.Array  # [M] or NOBODY
    price: jax.Array  # [M]


class _Search(NamedTuple):
    """Shortest paths from one row to the columns: to a column, on to its row, to a column, ..."""

    length: jax.Array  # [M] of the shortest path found so far
    before: jax.Array  # [M] last row on it
    settled: jax.Array  # [M] bool: gone on from
    nearest: jax.Array  # [] of the columns not settled


def assign(costs: jax.Array) -> jax.Array:
    """Column `[N]` of every row, or `NOBODY`: as many pairs as there can be, at the least total cost.

    Args:
        costs: `[N, M]`, finite.
    """
    num_rows, num_columns = costs.shape
    return _assign_all(costs).column if num_rows <= num_columns else _assign_all(costs.T).row


def _assign_all(costs: jax.Array) -> _Matching:
    """Assigns every row; there are no more rows than columns."""
    num_rows, num_columns = costs.shape
    nothing = jnp.full(num_rows, NOBODY), jnp.full(num_columns, NOBODY), jnp.zeros_like(costs[0])
    return jax.lax.while_loop(
        lambda matching: jnp.any(matching.column == NOBODY),
        lambda matching: _augment(matching, costs),
        _Matching(*nothing),
    )


def _augment(matching: _Matching, costs: jax.Array) -> _Matching:
    """Assigns one more row, and others anew along the shortest path to a free column."""
    column, row, price = matching
    start = jnp.argmin(column)
    columns = jnp.arange(row.size)

    def nearest(length: jax.Array, settled: jax.Array) -> jax.Array:
        free = jnp.where(row == NOBODY, length, jnp.inf)
        taken = jnp.where((row == NOBODY) | settled, jnp.inf, length)
        # Of equals a free one: it ends the search.
        return jnp.where(jnp.min(free) <= jnp.min(taken), jnp.argmin(free), jnp.argmin(taken))

    def go_on(search: _Search) -> _Search:
        length, before, settled, here = search
        settled = settled | (columns == here)
        reduced = costs[row[here]] - price
        onwards = length[here] + (reduced - reduced[here])
        shorter = ~settled & (onwards < length)
        length = jnp.where(shorter, onwards, length)
        return _Search(length, jnp.where(shorter, row[here], before), settled, nearest(length, settled))

    def swap(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        column, row, end = state
        last = before[end]
        row = jnp.where(columns == end, last, row)
        return jnp.where(jnp.arange(column.size) == last, end, column), row, column[last]

    length, settled = costs[start] - price, jnp.zeros_like(row, dtype=bool)
    # In a batch this is also called for a matching that has all rows: then it changes nothing.
    begin = jnp.where(column[start] == NOBODY, nearest(length, settled), NOBODY)
    length, before, settled, end = jax.lax.while_loop(
        lambda search: (search.nearest != NOBODY) & (row[search.nearest] != NOBODY),
        go_on,
        _Search(length, jnp.full_like(row, start), settled, begin),
    )
    price = price + jnp.where(settled, length - length[end], 0)
    column, row, _ = jax.lax.while_loop(lambda state: state[2] != NOBODY, swap, (column, row, end))
    return _Matching(column, row, price)
