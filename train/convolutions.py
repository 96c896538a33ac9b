"""Stacks of convolutions, each followed by a ReLU: by XLA, or as matrix products for the CPU.

XLA on the CPU runs a convolution inside `lax.scan` many times slower than outside
(jax issue 12868), and training lives in a scan. There an image is an array of blocks
`[Y, X, B, C]`, each of stride x stride pixels: every convolution is then one of stride 1 over
blocks, and as positions come first, what is done to whole blocks is done to long rows of numbers.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from train import winograd


class Layer(NamedTuple):
    """A square convolution without padding.

    Attributes:
        kernel: `[k, k, C, O]`.
        bias: `[O]`.
        stride: of both axes.
    """

    kernel: jax.Array
    bias: jax.Array
    stride: int


def by_xla(images: jax.Array, layers: list[Layer]) -> jax.Array:
    """Images `[B, H, W, C]` after all layers `[B, H', W', O]`, H' = (H - k) // stride + 1 of each."""
    for kernel, bias, stride in layers:
        dimensions = ("NHWC", "HWIO", "NHWC")
        convolved = jax.lax.conv_general_dilated(
            images, kernel, (stride, stride), "VALID", dimension_numbers=dimensions
        )
        images = jax.nn.relu(convolved + bias)
    return images


def by_matmul(images: jax.Array, layers: list[Layer]) -> jax.Array:
    """The same as matrix products.

    Raises:
        ValueError: if a stride does not divide the size of its kernel.
    """
    x = _into_blocks(images, layers[0].stride)
    following = [layer.stride for layer in layers[1:]]
    for (kernel, bias, stride), side in zip(layers, [*following, 1], strict=True):
        convolved = _convolve(x, _kernel_of_blocks(kernel, stride), side)
        x = jax.nn.relu(convolved + jnp.tile(bias, side**2))
    return jnp.moveaxis(x, 2, 0)


def _into_blocks(images: jax.Array, side: int) -> jax.Array:
    """Images `[B, H, W, C]` as blocks of side x side pixels, `[H // side, W // side, B, side^2 C]`."""
    batch, height, width, channels = images.shape
    rows, columns = height // side, width // side
    whole = images[:, : rows * side, : columns * side]
    blocks = whole.reshape(batch, rows, side, columns, side * channels)
    return blocks.transpose(1, 3, 0, 2, 4).reshape(rows, columns, batch, -1)


def _kernel_of_blocks(kernel: jax.Array, stride: int) -> jax.Array:
    """A kernel `[k, k, C, O]` of pixels as one of blocks, `[k / stride, k / stride, stride^2 C, O]`."""
    size, _, channels, features = kernel.shape
    if size % stride:
        raise ValueError(f"stride = {stride}: expected a divisor of the kernel size {size}")
    taps = size // stride
    split = kernel.reshape(taps, stride, taps, stride, channels, features)
    return split.transpose(0, 2, 1, 3, 4, 5).reshape(taps, taps, -1, features)


def _convolve(blocks: jax.Array, kernel: jax.Array, side: int) -> jax.Array:
    """Convolution of blocks `[Y, X, B, C]`, a kernel `[t, t, C, O]`; outputs in blocks of side x side."""
    if side == 1 and winograd.fits(blocks, kernel):
        return winograd.convolve(blocks, kernel)
    return _by_patches(blocks, kernel, side)


def _by_patches(blocks: jax.Array, kernel: jax.Array, side: int) -> jax.Array:
    """As one product, of the patches that the outputs see."""
    height, width, batch, _ = blocks.shape
    taps, features = kernel.shape[0], kernel.shape[-1]
    rows, columns = (height - taps + 1) // side, (width - taps + 1) // side
    seen = [
        blocks[y + i : y + i + rows * side : side, x + j : x + j + columns * side : side]
        for y, x in np.ndindex(side, side)
        for i, j in np.ndindex(taps, taps)
    ]
    patches = jnp.concatenate(seen, axis=-1).reshape(-1, kernel[..., 0].size)
    product = _tall_product(patches, kernel.reshape(-1, features))
    return product.reshape(rows, columns, batch, -1)


@jax.custom_vjp
def _tall_product(rows: jax.Array, weights: jax.Array) -> jax.Array:
    """`rows @ weights` `[N, K] x [K, O]` for many rows, with the gradient for the weights made quickly.

    XLA on the CPU works out `rows^T @ gradient` `[K, O]` at a third of the speed of its transpose
    `[O, K]` when K is several times O, as it is in convolutions.
    """
    return rows @ weights


def _tall_product_forward(rows: jax.Array, weights: jax.Array) -> tuple[jax.Array, Any]:
    return rows @ weights, (rows, weights)


def _tall_product_backward(saved: Any, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    rows, weights = saved
    # Without the barrier XLA merges the transposition into the product, which then is the slow one.
    transposed = jax.lax.optimization_barrier(gradient.T @ rows)
    return gradient @ weights.T, transposed.T


_tall_product.defvjp(_tall_product_forward, _tall_product_backward)
