"""Convolution with few products: Winograd's algorithm for images of a few positions.

Outputs of one axis are those of a polynomial's product with another, transposed. Two polynomials are
multiplied by their values at as many points as the product has coefficients (Toom-Cook), so inputs and
kernel are mixed by constant weights, multiplied point by point, and mixed again (Winograd 1980; Lavin
and Gray 2016, sections 3 and 4). In two axes that takes Y^2 products of matrices: 25 in place of 64 for
4 x 4 outputs of 2 x 2 taps, 16 in place of 36 for 2 x 2 outputs of 3 x 3 taps.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_POINTS = (0.0, 1.0, -1.0, 2.0)
"""Where polynomials are evaluated, beside infinity. More of them would cost digits."""


def fits(blocks: jax.Array, kernel: jax.Array) -> bool:
    """Whether blocks `[Y, X, B, C]` are a square that there are enough points for, with several outputs."""
    height, width, taps = *blocks.shape[:2], kernel.shape[0]
    return 1 < taps < height == width <= len(_POINTS) + 1


@jax.custom_vjp
def convolve(blocks: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolution of blocks `[Y, Y, B, C]` with a kernel `[t, t, C, O]`: `[Y - t + 1, Y - t + 1, B, O]`."""
    return _forward(blocks, kernel)[0]


def _forward(blocks: jax.Array, kernel: jax.Array) -> tuple[jax.Array, Any]:
    of_blocks, of_kernel, of_products = _mixing(len(blocks), len(kernel))
    mixed = _mix(of_blocks, blocks)
    return _mix(of_products, mixed @ _mix(of_kernel, kernel)), (mixed, kernel)


def _backward(saved: Any, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    mixed, kernel = saved
    of_blocks, of_kernel, of_products = _mixing(len(mixed), len(kernel))
    gradient = _mix(of_products.T, gradient)
    # The kernel is transposed before it is mixed: it is smaller then, and the product faster.
    of_mixed = gradient @ _mix(of_kernel, kernel.swapaxes(2, 3))
    return _mix(of_blocks.T, of_mixed), _mix(of_kernel.T, gradient.swapaxes(2, 3) @ mixed).swapaxes(2, 3)


convolve.defvjp(_forward, _backward)


def _mixing(inputs: int, taps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights with which `inputs` numbers, a kernel of `taps` and products are mixed, for one axis.

    In the order in which they are returned, outputs are `third @ ((first @ inputs) * (second @ kernel))`.
    """

    def values(coefficients: int) -> np.ndarray:
        finite = np.vander(_POINTS[: inputs - 1], coefficients, increasing=True)
        return np.vstack([finite, np.eye(coefficients)[-1]])

    return np.linalg.inv(values(inputs)).T, values(taps), values(inputs - taps + 1).T


def _mix(weights: np.ndarray, planes: jax.Array) -> jax.Array:
    """Mixes planes `[R, R, ...]` along both of their first axes with `weights` `[S, R]`: `[S, S, ...]`."""
    both = jnp.asarray(np.kron(weights, weights), planes.dtype)
    mixed = both @ planes.reshape(both.shape[1], -1)
    return mixed.reshape(len(weights), len(weights), *planes.shape[2:])
