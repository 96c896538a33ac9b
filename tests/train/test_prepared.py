"""A policy in two parts acts as the whole one."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.policies import POLICIES, Policy, PolicyBuilder
from train.prepared import prepare

pytestmark = pytest.mark.usefixtures("quick_compilation")

ENV = SearchTrack(StaticParams(num_truths=3, max_tracks=4, map_size=12, num_looks=5))
PARAMS = Params(beam_azimuth=0.5, beam_elevation=0.5)
STEPS = 30


def looks(policy: Policy, params: Params) -> np.ndarray:
    """Actions `[K, 2]` of an episode."""
    key = jax.random.key(1)

    def one_step(state: EnvState, key_step: jax.Array) -> tuple[EnvState, jax.Array]:
        action = policy(key, state)
        return ENV.play(key_step, state, action, params)[0], action

    _, start = ENV.reset_env(jax.random.key(0), params)
    return np.asarray(jax.lax.scan(one_step, start, jax.random.split(jax.random.key(2), STEPS))[1])


ALWAYS = ("random", "index_tuned", "sweep")
"""Rules of every test run; the others with -m medium."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ALWAYS else pytest.mark.medium) for name in POLICIES]
)
def test_acts_as_before(name: str) -> None:
    prepared = prepare(lambda weights: POLICIES[name], (), ENV, PARAMS)
    kept = prepared.work_out((), PARAMS)
    np.testing.assert_array_equal(
        looks(prepared.policy(kept), PARAMS), looks(POLICIES[name](ENV.static, PARAMS), PARAMS)
    )


def by_weight(weight: jax.Array) -> PolicyBuilder:
    """Always the look whose number is the weight times the beam's width, both known to the builder only."""

    def build(static: StaticParams, params: Params) -> Policy:
        worked_out = (weight * params.beam_azimuth).astype(int)
        return lambda key, state: jnp.stack([worked_out, state.time * 0])

    return build


@pytest.mark.parametrize(("weight", "beam", "first"), [(2.0, 0.5, 1), (6.0, 0.5, 3), (2.0, 1.0, 2)])
def test_weights_and_params_are_those_of_work_out(weight: float, beam: float, first: int) -> None:
    prepared = prepare(by_weight, jnp.asarray(0.0), ENV, PARAMS)
    params: Any = PARAMS.replace(beam_azimuth=beam)  # type: ignore[attr-defined]
    policy = prepared.policy(prepared.work_out(jnp.asarray(weight), params))
    np.testing.assert_array_equal(looks(policy, PARAMS), [[first, 0]] * STEPS)


def test_what_was_worked_out_is_not_worked_out_again() -> None:
    prepared = prepare(lambda weights: POLICIES["sweep"], (), ENV, PARAMS)
    kept = prepared.work_out((), PARAMS)
    _, state = ENV.reset_env(jax.random.key(0), PARAMS)

    def loops(policy: Any) -> int:
        return str(jax.make_jaxpr(policy)(jax.random.key(0), state)).count("scan[")

    # The search plan is one scan; a step of the policy has none of its own.
    whole = jax.make_jaxpr(lambda key, state: POLICIES["sweep"](ENV.static, PARAMS)(key, state))
    assert str(whole(jax.random.key(0), state)).count("scan[") == loops(prepared.policy(kept)) + 1
