"""The compiled step holds no more work than it should: counts of operations and kernels, never times.

`python -m benchmarks.program` prints the present numbers. Every bound is about 1.4 times the
count of the day it was set, so that a doubling fails and a new version of XLA mostly does not: after an
improvement, set them anew.
"""

import json
import re

import jax
import jax.numpy as jnp
import pytest

from benchmarks import playing, program
from jaxtrack import Params, StaticParams, make
from jaxtrack.policies import random

TOGETHER = {
    "operations": 5_000_000,
    "transcendentals": 37_000,
    "kilobytes": 8_700,
    "arithmetic": 2_500,
    "kernels": 80,
    "loops": 1,
}
ALONE = {"operations": 235_000, "transcendentals": 2_900, "kilobytes": 420, "arithmetic": 1_750}
"""Largest counts that pass, of the step of 64 environments and of the play of one."""

STAGES = 8
"""Fewest calls that are kept from being inlined in the play of one."""


@pytest.fixture(scope="module")
def together():
    return program.count(program.together(64, StaticParams(), Params()))


@pytest.fixture(scope="module")
def alone():
    return program.count(program.alone(StaticParams(), Params()))


@pytest.mark.medium
@pytest.mark.parametrize("name", TOGETHER)
def test_a_step_of_many_environments_grows_no_dearer(together, name):
    assert 0 <= getattr(together, name) <= TOGETHER[name]


@pytest.mark.medium
@pytest.mark.parametrize("name", ALONE)
def test_the_play_of_one_environment_grows_no_dearer(alone, name):
    assert 0 < getattr(alone, name) <= ALONE[name]


@pytest.mark.medium
def test_the_loop_over_environments_is_one_kernel(together):
    """All of `play` but the scan map; keys and the new truths of a new episode may be others."""
    assert 1 <= together.marked <= 4


@pytest.mark.medium
def test_stages_are_not_inlined(alone):
    assert alone.stages >= STAGES


@pytest.mark.medium
def test_the_map_is_renewed_in_place(static, params):
    """No step copies it: whether an episode ends hangs on the reward, the last that reads the old map."""
    env, _ = make(params, static)
    keys = jax.random.split(jax.random.key(0), 5)
    start = playing.begin(keys, params, env)
    lowered = jax.jit(lambda keys, start, params: playing.play(keys, start, params, env, random, 3)).lower(
        keys, start, params
    )
    text = lowered.compile().as_text()
    steps, maps = text[: text.index("\nENTRY")], re.escape(f"f32[5,{static.map_size},{static.map_size}]")
    assert re.search(rf"= {maps}\S* fusion\(", steps)
    assert not re.search(rf"= {maps}\S* copy\(", steps)


def test_counting():
    def function(x):
        return jax.lax.fori_loop(0, 9, lambda _, y: jnp.sin(y) + x * y, x)

    counts = program.count(jax.jit(function).lower(jnp.ones(1000)))
    # A loop counts once: a product, a sum and a sine of 1000 numbers, and the counter.
    assert counts.operations == pytest.approx(2000, abs=10)
    assert counts.transcendentals == 1000
    assert counts.loops == 1
    assert counts.kernels >= 1
    assert counts.arithmetic >= 2
    assert counts.marked == counts.stages == 0


def test_many_calls_are_traced_once(static):
    env, params = make(static=static)
    traces = []

    def play(keys, params):
        traces.append(keys.shape)
        state = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)[1]
        return jax.vmap(env.step, in_axes=(0, 0, None, None))(keys, state, jnp.zeros(2, int), params)[2]

    jitted = jax.jit(play)
    for seed in range(3):
        keys = jax.random.split(jax.random.key(seed), 2)
        jitted.trace(keys, params.replace(process_noise=1.0 + seed, clutter_rate=0.1 * seed))
    assert traces == [(2,)]


def test_command_prints_and_writes(tmp_path, monkeypatch, capsys):
    counts = program.Counts(1_234_567, 2, 3, 4, 5, 6, 7, 8)
    monkeypatch.setattr(program, "count", lambda _: counts)
    monkeypatch.setattr(program, "together", lambda *_: None)
    monkeypatch.setattr(program, "alone", lambda *_: None)
    file = tmp_path / "counts.json"
    assert program.main(["--num-envs", "8", "--markdown", "--out", str(file)]) == 0
    assert json.loads(file.read_text())["counts"]["step of 8"] == vars(counts)
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| step of 8 | 1,234,567 | 2 |")
    assert lines[3].startswith("| play of 1 |")


@pytest.mark.parametrize(
    ("arguments", "message"), [(["--num-envs", "1"], "num_envs = 1"), (["--out", "no/such/x.json"], "out = ")]
)
def test_wrong_options_end_before_anything_is_compiled(arguments, message, monkeypatch):
    monkeypatch.setattr(program, "count", lambda _: pytest.fail("compiled"))
    with pytest.raises(ValueError, match=message):
        program.main(arguments)
