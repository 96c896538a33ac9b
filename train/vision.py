"""NatureCNN on the scan map (Mnih et al. 2015; paper, section Network Design)."""

import jax
from flax import linen as nn

from train.convolutions import Layer, by_matmul, by_xla
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
        images = scan_map[:, :used, :used, None]  # one channel
        inputs, layers = 1, list[Layer]()
        for channels, size, stride in LAYERS:
            layers.append(Layer(*Convolution(channels, size)(inputs), stride))
            inputs = channels
        as_products = jax.default_backend() == "cpu" if self.by_matmul is None else self.by_matmul
        x = (by_matmul if as_products else by_xla)(images, layers)
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
    """Weights of a square convolution, with the names and shapes that `nn.Conv` gives them."""

    features: int
    size: int

    @nn.compact
    def __call__(self, inputs: int) -> tuple[jax.Array, jax.Array]:
        """Kernel `[size, size, inputs, features]` and bias `[features]`."""
        shape = (self.size, self.size, inputs, self.features)
        kernel = self.param("kernel", orthogonal(GAIN), shape)
        return kernel, self.param("bias", nn.initializers.zeros, (self.features,))
