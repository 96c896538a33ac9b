"""A gated recurrent unit over lists that stops where the longest of them ends, and its derivative.

Formulas and bias placement of PyTorch's `GRU` and flax's `GRUCell`:
``r, z = sigmoid(W_r x + U_r h), sigmoid(W_z x + U_z h)``, ``n = tanh(W_n x + r (U_n h + c))``,
``h' = (1 - z) n + z h``.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxtrack.kernel import stage


class Weights(NamedTuple):
    """Of a GRU from F features to H states; gates in the order r, z, n.

    Attributes:
        kernel: `[F, 3 H]` W of the rows.
        bias: `[3 H]` of the rows.
        recurrent_kernel: `[H, 3 H]` U of the state.
        recurrent_bias: `[H]` c of the state's part of n.
    """

    kernel: jax.Array
    bias: jax.Array
    recurrent_kernel: jax.Array
    recurrent_bias: jax.Array


class Passed(NamedTuple):
    """What every step found, for the way back.

    Attributes:
        state: `[T, B, H]` before the step.
        recurrent: `[T, B, 3 H]` the state's part of the gates.
    """

    state: jax.Array
    recurrent: jax.Array


class Turns(NamedTuple):
    """The order in which rows are read: up to the last one that counts in any list, or from there back.

    Attributes:
        number: of rows that are read.
        reverse: from the last to the first.
    """

    number: jax.Array
    reverse: bool

    def row(self, turn: jax.Array) -> jax.Array:
        """The row whose turn it is."""
        return self.number - 1 - turn if self.reverse else turn


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def gru(weights: Weights, rows: jax.Array, mask: jax.Array, reverse: bool) -> jax.Array:
    """State `[B, H]` of a GRU after all rows inside the mask; 0 where there is none.

    Args:
        weights: of the GRU.
        rows: `[T, B, F]`.
        mask: `[T, B]` which of them count; what the others hold must be finite.
        reverse: reads from the last row to the first.
    """
    inputs, turns = rows @ weights.kernel + weights.bias, _turns(mask, reverse)

    def step(turn: jax.Array, state: jax.Array) -> jax.Array:
        row = turns.row(turn)
        return _next(state, inputs[row], _recurrent(weights, state), mask[row])

    result: jax.Array = jax.lax.fori_loop(0, turns.number, step, _first(weights, mask))
    return result


def _gru_forward(weights: Weights, rows: jax.Array, mask: jax.Array, reverse: bool) -> tuple[jax.Array, Any]:
    inputs, turns = rows @ weights.kernel + weights.bias, _turns(mask, reverse)

    def step(turn: jax.Array, carry: tuple[jax.Array, Passed]) -> tuple[jax.Array, Passed]:
        (state, passed), row = carry, turns.row(turn)
        recurrent = _recurrent(weights, state)
        passed = Passed(passed.state.at[row].set(state), passed.recurrent.at[row].set(recurrent))
        return _next(state, inputs[row], recurrent, mask[row]), passed

    first = _first(weights, mask)
    passed = Passed(jnp.zeros((len(rows), *first.shape), first.dtype), jnp.zeros_like(inputs))
    state, passed = jax.lax.fori_loop(0, turns.number, step, (first, passed))
    return state, (weights, rows, mask, inputs, passed)


def _gru_backward(reverse: bool, saved: Any, gradient: jax.Array) -> tuple[Weights, jax.Array, None]:
    weights, rows, mask, inputs, passed = saved
    turns, hidden = _turns(mask, not reverse), weights.recurrent_kernel.shape[0]

    def step(turn: jax.Array, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        (gradient, of_gates), row = carry, turns.row(turn)
        inside = mask[row][:, None]
        _, pull = jax.vjp(update, passed.state[row], inputs[row], passed.recurrent[row])
        direct, of_inputs, of_recurrent = pull(jnp.where(inside, gradient, 0.0))
        gradient = jnp.where(inside, 0.0, gradient) + direct + of_recurrent @ weights.recurrent_kernel.T
        # Of r and z both parts have the same derivative.
        both = jnp.concatenate([of_inputs, of_recurrent[:, 2 * hidden :]], axis=-1)
        return gradient, of_gates.at[row].set(both)

    of_gates = jnp.zeros((*mask.shape, 4 * hidden), gradient.dtype)
    _, of_gates = jax.lax.fori_loop(0, turns.number, step, (gradient, of_gates))
    of_rows = of_gates[..., : 3 * hidden] @ weights.kernel.T
    return _of_weights(rows, passed.state, of_gates), of_rows, None


def _of_weights(rows: jax.Array, states: jax.Array, of_gates: jax.Array) -> Weights:
    """Gradient for all weights, by one product over all steps instead of one or two in each."""
    features, hidden = rows.shape[-1], states.shape[-1]
    read = jnp.concatenate([rows, jnp.ones_like(rows[..., :1]), states], axis=-1)
    product = read.reshape(-1, read.shape[-1]).T @ of_gates.reshape(-1, 4 * hidden)
    of_kernel, (of_bias,), of_states = jnp.split(product, [features, features + 1])
    return Weights(
        kernel=of_kernel[:, : 3 * hidden],
        bias=of_bias[: 3 * hidden],
        recurrent_kernel=jnp.concatenate([of_states[:, : 2 * hidden], of_states[:, 3 * hidden :]], axis=-1),
        recurrent_bias=of_bias[3 * hidden :],
    )


gru.defvjp(_gru_forward, _gru_backward)


def update(state: jax.Array, inputs: jax.Array, recurrent: jax.Array) -> jax.Array:
    """Next state of a GRU.

    Args:
        state: `[B, H]`.
        inputs: `[B, 3 H]` the row's part of the gates with its biases.
        recurrent: `[B, 3 H]` the state's part with its own.
    """
    input_r, input_z, input_n = jnp.split(inputs, 3, axis=-1)
    state_r, state_z, state_n = jnp.split(recurrent, 3, axis=-1)
    reset = jax.nn.sigmoid(input_r + state_r)
    keep = jax.nn.sigmoid(input_z + state_z)
    candidate = jnp.tanh(input_n + reset * state_n)
    return (1 - keep) * candidate + keep * state


def _next(state: jax.Array, inputs: jax.Array, recurrent: jax.Array, inside: jax.Array) -> jax.Array:
    # A stage: merged with the choice, what LLVM has of it is no longer vector instructions.
    return jnp.where(inside[:, None], stage(update)(state, inputs, recurrent), state)


def _recurrent(weights: Weights, state: jax.Array) -> jax.Array:
    hidden = state.shape[-1]
    return state @ weights.recurrent_kernel + jnp.pad(weights.recurrent_bias, (2 * hidden, 0))


def _first(weights: Weights, mask: jax.Array) -> jax.Array:
    return jnp.zeros((mask.shape[1], weights.recurrent_kernel.shape[0]), weights.kernel.dtype)


def _turns(mask: jax.Array, reverse: bool) -> Turns:
    number = jnp.max(jnp.where(mask.any(axis=1), jnp.arange(1, len(mask) + 1), 0))
    return Turns(number, reverse)
