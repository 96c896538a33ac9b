"""NatureCNN on the scan map (Mnih et al. 2015; paper, section Network Design).

XLA on the CPU runs a convolution inside `lax.scan` many times slower than outside
(jax issue 12868), and training lives in a scan. There the same convolution is written as
space-to-depth and one matrix product.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from train.orthogonal import orthogonal

GAIN = 2**0.5
"""Gain of the orthogonal initialisation of every layer but the heads (as in SB3)."""

LAYERS = ((32, 8, 4), (64, 4, 2), (64, 3, 1))
"""Channels, size of the kernel and stride of each convolution."""

SMALLEST_MAP = 36
"""Pixels along a side that leave one output to the last convolution."""


class NatureCNN(nn.Module):
    """Scan maps `[B, M, M]` in [0, 1] to latents z_SH `[B, features]`, M at least `SMALLEST_MAP`.

    Convolutions 8x8 stride 4, 4x4 stride 2 and 3x3 stride 1 without padding, then a dense
    layer; a ReLU after each.
    """

    features: int = 128
    by_matmul: bool | None = None
    """Convolutions as matrix products; None decides by the default backend (CPU: yes)."""

    @nn.compact
    def __call__(self, scan_map: jax.Array) -> jax.Array:
        """Maps scan maps `[B, M, M]` to latents `[B, features]`."""
        used = pixels_used(scan_map.shape[1])
        x = scan_map[:, :used, :used, None]  # one channel
        for channels, size, stride in LAYERS:
            x = nn.relu(Convolution(channels, size, stride, self.by_matmul)(x))
        x = x.reshape(x.shape[0], -1)
        return nn.relu(nn.Dense(self.features, kernel_init=orthogonal(GAIN))(x))


def pixels_used(size: int) -> int:
    """Pixels along a side of a map of `size` that reach the last convolution: 44 of 48.

    Strides leave pixels over at the far edges, and so do the strides of later layers, to which
    whole rows of outputs of the first would be of no use.
    """
    for _, kernel, stride in LAYERS:
        size = (size - kernel) // stride + 1
    for _, kernel, stride in reversed(LAYERS):
        size = (size - 1) * stride + kernel
    return size


class Convolution(nn.Module):
    """Square convolution without padding; parameters have the names and shapes of `nn.Conv`."""

    features: int
    size: int
    stride: int
    by_matmul: bool | None = None

    @nn.compact
    def __call__(self, images: jax.Array) -> jax.Array:
        """Maps images `[B, H, W, C]` to `[B, H', W', features]`, H' = (H - size) // stride + 1."""
        shape = (self.size, self.size, images.shape[-1], self.features)
        kernel = self.param("kernel", orthogonal(GAIN), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        by_matmul = jax.default_backend() == "cpu" if self.by_matmul is None else self.by_matmul
        convolve = convolve_by_matmul if by_matmul else convolve_by_xla
        return convolve(images, kernel, self.stride) + bias.reshape(1, 1, 1, -1)


def convolve_by_xla(images: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolution of images `[B, H, W, C]` with a kernel `[k, k, C, O]`, no padding."""
    return jax.lax.conv_general_dilated(
        images, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def convolve_by_matmul(images: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """The same convolution as one matrix product; `stride` must divide the kernel's size.

    Pixels are gathered into blocks of stride x stride. On blocks the kernel has stride 1 and
    k / stride taps per axis; shifted copies of the blocks, one per tap, lie side by side.

    Raises:
        ValueError: if the stride does not divide the size of the kernel.
    """
    size, _, channels, features = kernel.shape
    if size % stride:
        raise ValueError(f"stride = {stride}: expected a divisor of the kernel size {size}")
    batch, height, width, _ = images.shape
    rows, columns, taps = (height - size) // stride + 1, (width - size) // stride + 1, size // stride
    block_rows, block_columns = rows + taps - 1, columns + taps - 1
    depth = stride * stride * channels

    used = images[:, : block_rows * stride, : block_columns * stride]
    blocks = used.reshape(batch, block_rows, stride, block_columns, stride, channels)
    blocks = blocks.transpose(0, 1, 3, 2, 4, 5).reshape(batch, block_rows, block_columns, depth)
    shifted = [blocks[:, i : i + rows, j : j + columns] for i in range(taps) for j in range(taps)]

    weights = kernel.reshape(taps, stride, taps, stride, channels, features)
    weights = weights.transpose(0, 2, 1, 3, 4, 5).reshape(taps * taps * depth, features)
    patches = jnp.concatenate(shifted, axis=-1).reshape(-1, taps * taps * depth)
    return tall_product(patches, weights).reshape(batch, rows, columns, features)


@jax.custom_vjp
def tall_product(rows: jax.Array, weights: jax.Array) -> jax.Array:
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


tall_product.defvjp(_tall_product_forward, _tall_product_backward)
