"""Our NatureCNN is that of flax's layers with the same weights, in values and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from train.vision import Convolution, NatureCNN

pytestmark = pytest.mark.usefixtures("quick_compilation")


class ReferenceNatureCNN(nn.Module):
    """The same network of flax's own layers."""

    @nn.compact
    def __call__(self, scan_map):
        x = scan_map[..., None]
        for channels, size, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
            name = f"Convolution_{[8, 4, 3].index(size)}"
            conv = nn.Conv(channels, (size, size), (stride, stride), padding="VALID", name=name)
            x = nn.relu(conv(x))
        return nn.relu(nn.Dense(128)(x.reshape(x.shape[0], -1)))


def assert_trees_close(got, expected, tolerance=2e-5):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * float(jnp.max(jnp.abs(b))))


def test_nature_cnn_equals_flax(draw_variables, values_and_gradients):
    maps = jax.random.uniform(jax.random.key(0), (3, 48, 48))
    variables = draw_variables(ReferenceNatureCNN(), maps)
    expected = values_and_gradients(ReferenceNatureCNN().apply, variables, maps)
    assert expected[0].shape == (3, 128)
    assert 0.2 < np.mean(np.asarray(expected[0]) > 0) < 0.8  # neither dead nor linear
    for by_matmul in (True, False):
        ours = NatureCNN(by_matmul=by_matmul).apply
        assert_trees_close(values_and_gradients(ours, variables, maps), expected)


@pytest.mark.parametrize(("backend", "has_convolution"), [("cpu", False), ("gpu", True), ("tpu", True)])
def test_backend_decides_which_convolution(monkeypatch, backend, has_convolution):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    maps = jnp.zeros((1, 48, 48))
    network = NatureCNN()
    variables = jax.eval_shape(network.init, jax.random.key(0), maps)
    program = str(jax.make_jaxpr(network.apply)(variables, maps))
    assert ("conv_general_dilated" in program) == has_convolution


def test_orthogonal_initialisation():
    kernel = Convolution(8, 4).init(jax.random.key(0), 3)["params"]["kernel"]
    columns = np.asarray(kernel).reshape(-1, 8)
    np.testing.assert_allclose(columns.T @ columns, 2 * np.eye(8), atol=1e-5)
