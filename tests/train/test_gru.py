"""The GRU with a derivative of its own against the same formulas, row by row, differentiated by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.gru import Weights, gru, update

pytestmark = pytest.mark.usefixtures("quick_compilation")

BATCH, LENGTH, FEATURES, HIDDEN = 4, 6, 3, 5
MASKS = {
    "some rows": [[1, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0], [0, 0, 0, 1, 0, 0]],
    "all rows": [[1] * LENGTH] * BATCH,
    "the last row alone": [[0, 0, 0, 0, 0, 1], *[[0] * LENGTH] * 3],
    "no row": [[0] * LENGTH] * BATCH,
}


def row_by_row(weights, rows, mask, reverse):
    """The definition, without a loop that ends early."""
    state = jnp.zeros((BATCH, HIDDEN), rows.dtype)
    for row in range(LENGTH)[:: -1 if reverse else 1]:
        bias = jnp.concatenate([jnp.zeros(2 * HIDDEN), weights.recurrent_bias])
        recurrent = state @ weights.recurrent_kernel + bias
        after = update(state, rows[row] @ weights.kernel + weights.bias, recurrent)
        state = jnp.where(mask[row][:, None], after, state)
    return state


def arguments():
    rng = np.random.default_rng(0)
    shapes = Weights((FEATURES, 3 * HIDDEN), (3 * HIDDEN,), (HIDDEN, 3 * HIDDEN), (HIDDEN,))
    weights = Weights(*(jnp.asarray(rng.normal(size=shape)) for shape in shapes))
    return weights, jnp.asarray(rng.normal(size=(LENGTH, BATCH, FEATURES)))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("mask", list(MASKS.values()), ids=list(MASKS))
def test_state_and_gradients_are_those_of_the_definition(x64, mask, reverse):
    weights, rows = arguments()
    mask = jnp.asarray(mask, bool).T

    def outcome(function):
        def loss(weights, rows):
            state = function(weights, rows, mask, reverse)
            return jnp.sum(jnp.cos(state + jnp.arange(HIDDEN))), state

        return jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(weights, rows)

    (gradients, state), (expected, definition) = outcome(gru), outcome(row_by_row)
    np.testing.assert_allclose(state, definition, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(gru(weights, rows, mask, reverse), definition, rtol=1e-12, atol=1e-14)
    for got, wanted in zip(*map(jax.tree.leaves, (gradients, expected)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-11, atol=1e-13)
