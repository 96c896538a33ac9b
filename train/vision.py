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

    Columns are taken in strips of `stride`, whose numbers lie side by side in memory. A patch is k rows
    of k / stride such strips, in the order in which the kernel's weights lie.

    Raises:
        ValueError: if the stride does not divide the size of the kernel.
    """
    size, _, channels, features = kernel.shape
    if size % stride:
        raise ValueError(f"stride = {stride}: expected a divisor of the kernel size {size}")
    batch, height, width, _ = images.shape
    rows, columns, taps = (height - size) // stride + 1, (width - size) // stride + 1, size // stride
    used = images[:, :, : (columns + taps - 1) * stride]
    strips = used.reshape(batch, height, columns + taps - 1, stride * channels)
    last = (rows - 1) * stride + 1
    parts = [strips[:, i : i + last : stride, j : j + columns] for i in range(size) for j in range(taps)]
    patches = jnp.concatenate(parts, axis=-1).reshape(-1, size * size * channels)
    return tall_product(patches, kernel.reshape(-1, features)).reshape(batch, rows, columns, features)


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
