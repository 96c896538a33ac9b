"""Assignments against scipy."""

import jax
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxtrack.assignment import NOBODY, assign
from jaxtrack.kernel import one_by_one

SHAPES = [(1, 1), (1, 6), (6, 1), (5, 5), (4, 9), (9, 4), (10, 20)]
BATCH = 60


def random_costs(shape):
    """Costs `[BATCH, N, M]`: all different, many equal, most at a plateau as GOSPA's, all equal."""
    costs = np.random.default_rng(0).normal(size=(BATCH, *shape))
    costs[20:40] = np.round(1.5 * costs[20:40])
    costs[40:] = np.minimum(np.abs(costs[40:]), 0.3)
    costs[-1] = 0.3
    return costs


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("shape", SHAPES)
def test_the_total_cost_is_the_least(shape):
    costs = random_costs(shape)
    for one, columns in zip(costs, np.asarray(jax.jit(jax.vmap(one_by_one(assign)))(costs)), strict=True):
        rows = np.flatnonzero(columns != NOBODY)
        assert len(rows) == len(set(columns[rows])) == min(shape)
        assert set(columns[rows]) <= set(range(shape[1]))
        least = one[linear_sum_assignment(one)].sum()
        np.testing.assert_allclose(one[rows, columns[rows]].sum(), least, atol=1e-12)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("shape", [(5, 5), (9, 4)])
def test_in_a_batch_as_alone(shape):
    costs = random_costs(shape)
    alone = np.stack([jax.jit(assign)(one) for one in costs])
    np.testing.assert_array_equal(jax.jit(jax.vmap(assign))(costs), alone)
    np.testing.assert_array_equal(jax.jit(jax.vmap(one_by_one(assign)))(costs), alone)
