"""What the tests of networks share."""

import jax
import jax.numpy as jnp
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
def values_and_gradients():
    """Outputs of `apply(variables, inputs)`, and gradients of a weighted sum of them for both."""

    def compute(apply, variables, inputs):
        def loss(variables, inputs):
            out = apply(variables, inputs)
            return jnp.sum(out * jnp.cos(jnp.arange(out.size).reshape(out.shape))), out

        pull = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)
        (_, out), gradients = jax.jit(pull)(variables, inputs)
        return out, gradients

    return compute


@pytest.fixture(scope="session")
def apply():
    """`module.apply` compiled once for every module and shape."""

    def compiled(module, variables, *inputs, **named):
        return module.apply(variables, *inputs, **named)

    return jax.jit(compiled, static_argnums=0)
