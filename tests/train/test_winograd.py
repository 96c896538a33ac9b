"""Convolution with few products is the convolution, and does take few."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train import winograd

pytestmark = pytest.mark.usefixtures("quick_compilation")

SIZES = [(3, 2), (4, 2), (5, 2), (4, 3), (5, 3), (5, 4)]


def directly(blocks, kernel):
    """Sum over the taps of the kernel."""
    taps, outputs = len(kernel), len(blocks) - len(kernel) + 1
    return sum(blocks[i : i + outputs, j : j + outputs] @ kernel[i, j] for i, j in np.ndindex(taps, taps))


def draw(side, taps):
    """Blocks and a kernel, and weights of the outputs."""
    shapes = (side, side, 6, 32), (taps, taps, 32, 8), (side - taps + 1, side - taps + 1, 6, 8)
    return [jax.random.normal(jax.random.key(i), shape, float) for i, shape in enumerate(shapes)]


def with_gradients(convolve, blocks, kernel, weights):
    out, pull = jax.vjp(convolve, blocks, kernel)
    return out, *pull(weights)


@pytest.mark.parametrize(("side", "taps"), SIZES)
def test_it_is_the_convolution(x64, side, taps):
    blocks, kernel, weights = draw(side, taps)
    assert winograd.fits(blocks, kernel)
    got = with_gradients(winograd.convolve, blocks, kernel, weights)
    expected = with_gradients(directly, blocks, kernel, weights)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * float(jnp.max(jnp.abs(b))))


@pytest.mark.parametrize(("side", "taps"), SIZES)
def test_single_precision_loses_one_digit_at_most(x64, side, taps):
    exact = with_gradients(directly, *draw(side, taps))
    single = [array.astype(jnp.float32) for array in draw(side, taps)]

    def errors(convolve):
        got = with_gradients(convolve, *single)
        return [float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b)) for a, b in zip(got, exact, strict=True)]

    for few, many in zip(errors(winograd.convolve), errors(directly), strict=True):
        assert few < 10 * many
        assert few < 2e-6


@pytest.mark.parametrize(("height", "width", "taps"), [(5, 5, 1), (3, 3, 3), (6, 6, 3), (6, 6, 2), (5, 4, 2)])
def test_what_does_not_fit(height, width, taps):
    assert not winograd.fits(jnp.zeros((height, width, 1, 1)), jnp.zeros((taps, taps, 1, 1)))


def test_it_takes_fewer_operations():
    """Mixing included, for NatureCNN's second convolution and a piece of 64 samples."""
    blocks, kernel = jnp.zeros((5, 5, 64, 128)), jnp.zeros((2, 2, 128, 64))
    few, many = (
        jax.jit(convolve).lower(blocks, kernel).compile().cost_analysis()["flops"]
        for convolve in (winograd.convolve, directly)
    )
    assert many > 64 * 2 * 16 * 4 * 128 * 64
    assert few < 0.7 * many
