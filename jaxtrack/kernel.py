"""How a CPU steps one scenario after the other, all in one piece of machine code.

XLA runs a program on a CPU as a list of small kernels, and to start one costs as much as the
arithmetic of a whole step of one scenario. A mark that other devices ignore makes it compile a
loop as a single kernel, in which `jax.lax.cond` is a real branch: a look at an empty sky
updates no track.

Such a kernel can not hold what XLA leaves to libraries: sorts, scatters, matrix products and
large sums. `add_up` and `jaxtrack.sampling.places` stand in for them.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental.xla_metadata import set_xla_metadata

Function = Callable[..., Any]

_ONE_KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}
_NOT_INLINED = {"inlineable": "false"}
_UNMARKED = {"inlineable": "true", "xla_cpu_small_call": "false"}


def one_by_one(function: Function) -> Function:
    """`function` of arrays, which `jax.vmap` runs for one row after the other instead of for all at once.

    Only on a CPU; for other devices `function` is left as it is.
    """
    if jax.default_backend() != "cpu":
        return function
    looped = custom_vmap(function)

    @looped.def_vmap
    def in_a_loop(size: int, batched: list[Any], *arguments: Any) -> tuple[Any, Any]:
        del size
        leaves, tree = jax.tree.flatten(arguments)
        varies = jax.tree.leaves(tuple(batched))

        def loop(*leaves: jax.Array) -> Any:
            def one(row: list[jax.Array]) -> Any:
                rest = iter(row)
                merged = [next(rest) if each else leaf for leaf, each in zip(leaves, varies, strict=True)]
                return function(*jax.tree.unflatten(tree, merged))

            return jax.lax.map(one, [leaf for leaf, each in zip(leaves, varies, strict=True) if each])

        # The next `jax.vmap` must not turn the branches in the loop into choices either.
        result = in_one_kernel(one_by_one(loop), *leaves)
        return result, jax.tree.map(lambda _: True, result)

    return looped


def in_one_kernel(function: Function, *arguments: jax.Array) -> Any:
    """``function(*arguments)``, on a CPU as a single kernel; not to be called inside another one."""
    if jax.default_backend() != "cpu":
        return function(*arguments)
    # XLA ends the process over an argument that is a constant, and over one that it found to be of no
    # use: hence the barriers, and all arguments come back.
    called = _as_call(function, _ONE_KERNEL)
    return jax.lax.optimization_barrier(called(*jax.lax.optimization_barrier(arguments)))[0]


def rarely(needed: jax.Array, function: Function, arguments: tuple[Any, ...], otherwise: Any) -> Any:
    """``function(*arguments)`` where `needed` `[]`, else `otherwise`, a pytree of the same arrays.

    Under `jax.vmap` on a CPU nothing is computed, nor gone through, as long as no row needs it.
    """

    def choose(needed: jax.Array, arguments: tuple[Any, ...], otherwise: Any) -> Any:
        return jax.lax.cond(needed, lambda: function(*arguments), lambda: otherwise)

    if jax.default_backend() != "cpu":
        return choose(needed, arguments, otherwise)
    chooser = custom_vmap(choose)

    @chooser.def_vmap
    def if_any(size: int, batched: list[Any], *values: Any) -> tuple[Any, Any]:
        needed, arguments, otherwise = values
        otherwise = jax.tree.map(
            lambda leaf, has_rows: leaf if has_rows else jnp.broadcast_to(leaf, (size, *jnp.shape(leaf))),
            otherwise,
            batched[2],
        )
        rows = jax.tree.map(lambda has_rows: 0 if has_rows else None, tuple(batched[:2]))
        result = jax.lax.cond(
            jnp.any(needed),
            lambda: jax.vmap(choose, in_axes=(*rows, 0))(needed, arguments, otherwise),
            lambda: otherwise,
        )
        return result, jax.tree.map(lambda _: True, result)

    return chooser(needed, arguments, otherwise)


def stage(function: Function) -> Function:
    """`function` of arrays, worked out once however many results need it.

    XLA for CPUs would rather repeat arithmetic for every result that needs it; it does not look
    into a function that is called instead of inlined. Other devices get `function` as it is.
    """
    called = _as_call(function, _NOT_INLINED)

    @functools.wraps(function)
    def staged(*arguments: Any) -> Any:
        return called(*arguments)[0] if jax.default_backend() == "cpu" else function(*arguments)

    return staged


def add_up(terms: jax.Array, axis: int = 0) -> jax.Array:
    """Sum over a short axis, written out term by term."""
    return functools.reduce(operator.add, jnp.unstack(terms, axis=axis))


def _as_call(function: Function, marks: dict[str, str]) -> Function:
    """`function` as one marked HLO call, which returns its arguments beside the result.

    Traced once for all calls with the same shapes.
    """

    def unmarked(*arguments: Any) -> Any:
        # The marks are for the call alone; all that it holds would inherit them.
        with set_xla_metadata(**_UNMARKED):
            return function(*arguments), arguments

    jitted = jax.jit(unmarked)

    def call(*arguments: Any) -> Any:
        with set_xla_metadata(**marks):
            return jitted(*arguments)

    return call
