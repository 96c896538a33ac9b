"""What the tests of networks share."""

import jax
import numpy as np
import pytest


@pytest.fixture(scope="session")
def draw_variables():
    """Draws variables for a module without compiling its initialisation.

    Biases and scales are random too, so that one lost or leaking is seen.
    """

    def draw(module, *inputs, seed=0):
        rng = np.random.default_rng(seed)

        def weights(array):
            if array.ndim == 1:
                return rng.normal(0, 0.2, array.shape).astype(array.dtype)
            fan_in = np.prod(array.shape[:-1])
            return rng.normal(0, fan_in**-0.5, array.shape).astype(array.dtype)

        return jax.tree.map(weights, jax.eval_shape(module.init, jax.random.key(0), *inputs))

    return draw


@pytest.fixture(scope="session")
def apply():
    """`module.apply` compiled once for every module and shape."""

    def compiled(module, variables, *inputs, **named):
        return module.apply(variables, *inputs, **named)

    return jax.jit(compiled, static_argnums=0)
