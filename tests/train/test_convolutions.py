"""Stacks of convolutions are flax's with the same weights, in values and gradients."""

import jax
import jax.numpy as jnp
import pytest
from flax import linen as nn

from train import winograd
from train.convolutions import Layer, by_matmul, by_xla

pytestmark = pytest.mark.usefixtures("quick_compilation")


class Stack(nn.Module):
    """Of `nn.Conv` layers (features, kernel size, stride), each followed by a ReLU."""

    layers: tuple[tuple[int, int, int], ...]

    @nn.compact
    def __call__(self, images):
        for features, size, stride in self.layers:
            images = nn.relu(nn.Conv(features, (size, size), (stride, stride), padding="VALID")(images))
        return images


def ours(function, layers):
    """`function` as a network with the variables of `Stack`."""

    def apply(variables, images):
        weights = [variables["params"][f"Conv_{i}"] for i in range(len(layers))]
        strides = [stride for _, _, stride in layers]
        return function(
            images, [Layer(each["kernel"], each["bias"], s) for each, s in zip(weights, strides, strict=True)]
        )

    return apply


STACKS = {
    "stride of several columns": ((11, 13, 5), ((7, 4, 2),)),
    "pixels left over": ((13, 18, 1), ((7, 6, 3),)),
    "blocks for the next layer": ((29, 26, 3), ((4, 6, 3), (5, 4, 2))),
    "blocks left over": ((14, 16, 2), ((3, 4, 2), (5, 3, 3))),
    "4 x 4 outputs of 2 x 2 taps": ((10, 10, 3), ((5, 4, 2),)),
    "2 x 2 outputs of 3 x 3 taps": ((4, 4, 3), ((5, 3, 1),)),
    "NatureCNN": ((44, 44, 1), ((8, 8, 4), (6, 4, 2), (5, 3, 1))),
    "too large for few products": ((60, 60, 1), ((8, 8, 4), (6, 4, 2), (5, 3, 1))),
}


@pytest.mark.parametrize("name", STACKS)
def test_both_are_flax(x64, draw_variables, values_and_gradients, name):
    shape, layers = STACKS[name]
    images = jax.random.normal(jax.random.key(0), (3, *shape))
    variables = draw_variables(Stack(layers), images)
    variables = jax.tree.map(lambda leaf: leaf.astype(float), variables)
    expected = values_and_gradients(Stack(layers).apply, variables, images)
    assert jnp.mean(expected[0] > 0) > 0.1
    for function in (by_matmul, by_xla):
        got = values_and_gradients(ours(function, layers), variables, images)
        for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
            assert jnp.allclose(a, b, rtol=1e-9, atol=1e-9 * float(jnp.max(jnp.abs(b))))


def test_stride_that_does_not_divide_the_kernel_is_refused():
    layer = Layer(jnp.zeros((3, 3, 1, 1)), jnp.zeros(1), 2)
    with pytest.raises(ValueError, match="stride = 2"):
        by_matmul(jnp.zeros((1, 9, 9, 1)), [layer])


@pytest.mark.parametrize(("pixels", "layers_of_few"), [(44, 2), (60, 0)])
def test_small_images_take_few_products(monkeypatch, pixels, layers_of_few):
    taken, convolve = [], winograd.convolve
    monkeypatch.setattr(winograd, "convolve", lambda *given: taken.append(given) or convolve(*given))
    shapes = ((8, 1, 8), (4, 8, 6), (3, 6, 5))
    layers = [
        Layer(jnp.zeros((k, k, c, o)), jnp.zeros(o), s)
        for (k, c, o), s in zip(shapes, (4, 2, 1), strict=True)
    ]
    jax.eval_shape(lambda images: by_matmul(images, layers), jnp.zeros((2, pixels, pixels, 1)))
    assert len(taken) == layers_of_few
