"""Stepping one scenario after the other in one piece of machine code changes no result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import kernel, make
from jaxtrack.env import LARGEST_IN_ONE_KERNEL


def rows(*shape):
    return jnp.asarray(np.random.default_rng(0).normal(size=shape))


def branching(x, scale):
    """A branch that depends on the row, a loop, and several results."""
    y = jax.lax.cond(x.sum() > 0, lambda: jnp.sin(x) * scale["up"], lambda: x - scale["down"])
    return {"row": y, "total": jax.lax.fori_loop(0, 3, lambda _, total: total + y.sum(), 0.0)}


UP = {"up": 0, "down": None}
SCALE = {"up": jnp.asarray(2.0), "down": jnp.arange(5.0)}


@pytest.mark.parametrize(
    "in_axes", [(0, None), (None, {"up": 0, "down": None}), (0, {"up": 0, "down": None})]
)
def test_one_by_one_equals_all_at_once(in_axes):
    x = rows(7, 5) if in_axes[0] == 0 else rows(5)
    scale = SCALE if in_axes[1] is None else {**SCALE, "up": rows(7)}
    together = jax.jit(jax.vmap(branching, in_axes))(x, scale)
    in_turn = jax.jit(jax.vmap(kernel.one_by_one(branching), in_axes))(x, scale)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), in_turn, together)


def test_batches_of_batches():
    x = rows(3, 4, 5)
    both = lambda function: jax.vmap(jax.vmap(function, in_axes=(0, None)), in_axes=(0, None))  # noqa: E731
    found, expected = jax.jit(both(kernel.one_by_one(branching)))(x, SCALE), both(branching)(x, SCALE)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)


def compiled_text(function, *arguments):
    return jax.jit(function).lower(*arguments).compile().as_text()


def test_it_is_one_kernel():
    """Otherwise everything still works, many times slower."""
    text = compiled_text(jax.vmap(kernel.one_by_one(branching), in_axes=(0, None)), rows(7, 5), SCALE)
    entry = text[text.index("ENTRY") :]
    assert 'xla_cpu_small_call="true"' in entry
    assert " while(" not in entry


def doubled_where_positive(x, otherwise):
    return kernel.rarely(x.sum() > 0, lambda x: 2 * x, (x,), otherwise)


@pytest.mark.parametrize("shift", [0.0, 9.0, -9.0])
def test_rarely_is_a_choice_row_by_row_whether_some_all_or_no_row_needs_it(shift):
    x = rows(7, 5) + shift
    needed = x.sum(axis=1, keepdims=True) > 0
    assert bool(needed.any()) == (shift >= 0)
    assert bool(needed.all()) == (shift > 0)
    for otherwise, in_axes in ((rows(7, 5) - 1, (0, 0)), (jnp.arange(5.0), (0, None))):
        found = jax.jit(jax.vmap(doubled_where_positive, in_axes))(x, otherwise)
        np.testing.assert_array_equal(found, jnp.where(needed, 2 * x, otherwise))
    np.testing.assert_array_equal(doubled_where_positive(x[0], x[1]), 2 * x[0] if needed[0] else x[1])


def test_rarely_computes_nothing_as_long_as_no_row_needs_it():
    seen = []

    def noted(x):
        jax.debug.callback(lambda: seen.append(1))
        return 2 * x

    together = jax.jit(jax.vmap(lambda x: kernel.rarely(x.sum() > 0, noted, (x,), x)))
    for x, needed in ((-jnp.ones((3, 2)), False), (jnp.ones((3, 2)).at[0].set(-1), True)):
        jax.block_until_ready(together(x))
        jax.effects_barrier()
        assert bool(seen) == needed


def test_a_step_of_the_environment_is_one_kernel_and_so_is_the_split_of_its_key(static):
    env, params = make(static=static)
    keys, action = jax.random.split(jax.random.key(0), 3), jnp.zeros(2, dtype=int)
    states = jax.eval_shape(jax.vmap(env.reset_env, in_axes=(0, None)), keys, params)[1]
    lowered = jax.jit(jax.vmap(env.step, in_axes=(0, 0, None, None))).lower(keys, states, action, params)
    assert lowered.as_text().count('xla_cpu_small_call = "true"') == 2


def test_other_devices_get_no_marks(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    both = kernel.one_by_one(kernel.stage(branching))
    lowered = jax.jit(jax.vmap(both, in_axes=(0, None))).lower(rows(7, 5), SCALE)
    assert "frontend_attributes" not in lowered.as_text()


def test_arguments_of_no_use_are_harmless():
    """XLA ended the process over an argument that only its own simplifications made useless."""

    def function(x, unused):
        return x + (unused.astype(int) * 0).astype(x.dtype)

    found = jax.jit(jax.vmap(kernel.one_by_one(function), in_axes=(0, None)))(rows(3, 5), jnp.ones(()))
    np.testing.assert_array_equal(found, rows(3, 5))


def test_constants_are_harmless():
    found = jax.jit(lambda: jax.vmap(kernel.one_by_one(branching), in_axes=(0, None))(rows(7, 5), SCALE))()
    np.testing.assert_allclose(found["row"], jax.vmap(branching, in_axes=(0, None))(rows(7, 5), SCALE)["row"])


def test_constants_made_inside_are_harmless():
    """XLA ended the process over an argument that was worked out to a constant."""

    def drawn(x):
        return kernel.one_by_one(lambda x, key: jax.random.uniform(key) + x)(x, jax.random.key(3))

    found = jax.jit(jax.vmap(drawn))(jnp.zeros(4))
    np.testing.assert_allclose(found, jnp.full(4, jax.random.uniform(jax.random.key(3))), rtol=1e-6)


def test_batches_of_batches_keep_their_branches():
    both = jax.vmap(jax.vmap(kernel.one_by_one(branching), in_axes=(0, None)), in_axes=(0, None))
    assert " conditional(" in compiled_text(both, rows(3, 4, 5), SCALE)


def test_a_stage_changes_nothing():
    x = rows(4, 5)
    staged, plain = (jax.vmap(each, in_axes=(0, None)) for each in (kernel.stage(branching), branching))
    np.testing.assert_allclose(jax.jit(staged)(x, SCALE)["row"], plain(x, SCALE)["row"], rtol=1e-6)


def test_add_up():
    x = rows(4, 5)
    np.testing.assert_allclose(kernel.add_up(x), x.sum(axis=0), rtol=1e-6)
    np.testing.assert_allclose(kernel.add_up(x, axis=-1), x.sum(axis=-1), rtol=1e-5)


def step_together_and_alone(shapes):
    env, params = make(**shapes, beam_azimuth=2.0, beam_elevation=1.0, clutter_rate=2.0)
    keys, action = jax.random.split(jax.random.key(0), 2), jnp.array([9, 9])
    _, states = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)
    together, _ = jax.jit(jax.vmap(env.play, in_axes=(0, 0, None, None)))(keys, states, action, params)
    advance = jax.jit(env.advance)
    for i in range(2):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        alone, record = advance(state, action, env.sample_noise(keys[i]), params)
        yield jax.tree.map(lambda leaf, i=i: leaf[i], together), alone, record


@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("largest", [pytest.param(200, marks=pytest.mark.medium), 5])
def test_together_a_scenario_steps_as_alone_however_large(monkeypatch, largest):
    monkeypatch.setitem(LARGEST_IN_ONE_KERNEL, "max_tracks", largest)
    for together, alone, record in step_together_and_alone(
        {"max_tracks": 6, "num_truths": 5, "map_size": 12}
    ):
        assert int(record.detections.active.sum()) > 0
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-3), together, alone)


@pytest.mark.slow
def test_the_largest_scenario_compiles_with_all_optimisations():
    for together, alone, _ in step_together_and_alone(LARGEST_IN_ONE_KERNEL):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-3), together, alone)
