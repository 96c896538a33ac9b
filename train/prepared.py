"""A policy in two parts: what its builder works out once, and what it does at every step.

A search plan takes as long as thousands of steps. A program that is called for every chunk of
episodes gets it as an argument instead of making it anew.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxtrack.env import SearchTrack
from jaxtrack.params import Params
from jaxtrack.policies import Policy, PolicyBuilder

Kept = list[jax.Array]
"""The arrays that a policy keeps."""


class Prepared(NamedTuple):
    """A policy after `prepare`.

    Attributes:
        work_out: weights and params to what the policy keeps; compiled.
        policy: what it keeps to the policy.
    """

    work_out: Callable[[Any, Params], Kept]
    policy: Callable[[Kept], Policy]


def prepare(
    build: Callable[[Any], PolicyBuilder], weights: Any, env: SearchTrack, params: Params
) -> Prepared:
    """Splits the policy that `build` makes of weights, for all weights shaped like these."""
    key, state = jax.eval_shape(lambda key: (key, env.reset_env(key, params)[1]), jax.random.key(0))
    steps = []

    def work_out(weights: Any, params: Params) -> Kept:
        step = jax.make_jaxpr(build(weights)(env.static, params))(key, state)
        steps.append(step.jaxpr)
        return step.consts

    compiled = jax.jit(work_out).lower(weights, params).compile()

    def policy(kept: Kept) -> Policy:
        step = jaxpr_as_fun(ClosedJaxpr(steps[-1], kept))
        return lambda key, state: step(*jax.tree.leaves((key, state)))[0]

    return Prepared(compiled, policy)
