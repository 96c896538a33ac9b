"""Encoders: padding is never seen, and GRU and attention are the textbook's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from train.encoders import GRU, AttentionEncoder, BiGRUEncoder, FlattenEncoder, SelfAttention

pytestmark = pytest.mark.usefixtures("quick_compilation")

ENCODERS = [FlattenEncoder(), BiGRUEncoder(), AttentionEncoder()]
each_encoder = pytest.mark.parametrize("encoder", ENCODERS, ids=["flatten", "bigru", "mhsa"])
MASK = jnp.array(
    [[True, False, True, True, False], [False] * 5, [True] * 5, [False, False, False, False, True]]
)


@pytest.fixture(scope="module")
def tracks():
    return jax.random.normal(jax.random.key(0), (*MASK.shape, 7))


def with_padding(tracks, value):
    return jnp.where(MASK[..., None], tracks, value)


@each_encoder
def test_padding_changes_neither_values_nor_gradients(draw_variables, encoder, tracks):
    variables = draw_variables(encoder, tracks, MASK)

    @jax.jit
    def outcome(tracks):
        def loss(variables, tracks):
            z = encoder.apply(variables, tracks, MASK)
            return jnp.sum(z * jnp.cos(jnp.arange(z.size).reshape(z.shape))), z

        return jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(variables, tracks)

    expected = (_, z), gradients = outcome(with_padding(tracks, 0.0))
    assert z.shape == (4, 64)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((z, gradients)))
    assert np.any(gradients[1][0, 0] != 0)
    assert np.all(gradients[1][~MASK] == 0)
    for value in (jnp.nan, jnp.inf, -1e30, 3.0):
        changed = outcome(with_padding(tracks, value))
        jax.tree.map(np.testing.assert_array_equal, changed, expected)


@each_encoder
def test_every_track_and_feature_matters_and_no_other(apply, draw_variables, encoder, tracks):
    variables = draw_variables(encoder, tracks, MASK)
    batch, length, features = tracks.shape
    changes = np.eye(length * features, dtype=np.float32).reshape(-1, 1, length, features)
    changed = jnp.concatenate([tracks[None], tracks[None] + changes]).reshape(-1, length, features)
    masks = jnp.tile(MASK, (1 + len(changes), 1))
    z = np.asarray(apply(encoder, variables, changed, masks)).reshape(-1, batch, 64)
    moved = np.any(np.abs(z[1:] - z[0]) > 1e-4, axis=-1).reshape(length, features, batch)
    np.testing.assert_array_equal(moved, np.broadcast_to(MASK.T[:, None, :], moved.shape))


@pytest.mark.parametrize("encoder", ENCODERS[1:], ids=["bigru", "mhsa"])
def test_slots_that_the_tracks_occupy_do_not_matter(apply, draw_variables, encoder, tracks):
    """Only the order of the live tracks counts for a recurrent encoder."""
    variables = draw_variables(encoder, tracks, MASK)
    compact = jnp.argsort(~MASK, axis=1, stable=True)
    moved = jnp.take_along_axis(with_padding(tracks, jnp.nan), compact[..., None], axis=1)
    mask = jnp.take_along_axis(MASK, compact, axis=1)
    np.testing.assert_allclose(
        apply(encoder, variables, moved, mask),
        apply(encoder, variables, tracks, MASK),
        rtol=1e-5,
        atol=1e-6,
    )


@pytest.mark.parametrize("reverse", [False, True])
def test_gru_equals_flax_cell_on_the_rows_inside_the_mask(apply, draw_variables, reverse, tracks):
    hidden = 6
    gru = GRU(hidden, reverse=reverse)
    clean = with_padding(tracks, 0.0)
    variables = draw_variables(gru, clean, MASK)
    states = apply(gru, variables, clean, MASK)
    cell, cell_variables = nn.GRUCell(hidden), flax_cell_variables(variables["params"], hidden)
    for state, rows, inside in zip(states, clean, MASK, strict=True):
        carry = jnp.zeros(hidden)
        for row in rows[inside][:: -1 if reverse else 1]:
            carry, _ = apply(cell, cell_variables, carry, row)
        np.testing.assert_allclose(state, carry, rtol=1e-5, atol=1e-6)


def flax_cell_variables(params, hidden):
    def gate(index, recurrent_bias):
        part = slice(index * hidden, (index + 1) * hidden)
        inputs = {name: array[..., part] for name, array in params.items() if name in ("kernel", "bias")}
        return inputs, {"kernel": params["recurrent_kernel"][:, part]} | recurrent_bias

    cell = {}
    for index, name in enumerate("rzn"):
        bias = {"bias": params["recurrent_bias"]} if name == "n" else {}
        cell[f"i{name}"], cell[f"h{name}"] = gate(index, bias)
    return {"params": cell}


def test_self_attention_equals_flax(apply, draw_variables):
    embedding, heads = 12, 3
    x = jax.random.normal(jax.random.key(3), (*MASK.shape, embedding))
    ours = SelfAttention(heads)
    variables = draw_variables(ours, x, MASK)
    theirs = nn.MultiHeadDotProductAttention(num_heads=heads)
    qkv, out = variables["params"]["qkv"], variables["params"]["out"]
    params = {"out": {"kernel": out["kernel"].reshape(heads, -1, embedding), "bias": out["bias"]}}
    for i, name in enumerate(("query", "key", "value")):
        params[name] = {
            "kernel": qkv["kernel"].reshape(embedding, 3, heads, -1)[:, i],
            "bias": qkv["bias"].reshape(3, heads, -1)[i],
        }
    pairs = jnp.broadcast_to(MASK[:, None, None, :], (4, 1, 5, 5))
    expected = apply(theirs, {"params": params}, x, x, mask=pairs)
    np.testing.assert_allclose(apply(ours, variables, x, MASK), expected, rtol=1e-4, atol=1e-5)


def test_attention_lets_tracks_see_each_other(apply, draw_variables):
    """Before the BiGRU every row depends on itself and on every live row, and on no other."""
    x = jax.random.normal(jax.random.key(3), (MASK.shape[1], 8))
    attention = SelfAttention(2)
    variables = draw_variables(attention, x[None], MASK[:1])
    changed = x[None] + jnp.eye(len(x))[:, :, None]
    after = apply(attention, variables, changed, jnp.tile(MASK[:1], (len(x), 1)))
    moved = np.any(np.abs(after - apply(attention, variables, x[None], MASK[:1])) > 1e-4, axis=-1)
    np.testing.assert_array_equal(moved, MASK[0][:, None] | np.eye(len(x), dtype=bool))
