"""All cores of a machine without an accelerator: each a device of its own, with its share of the scenarios.

    from jaxtrack import cores

    cores.use()  # before the environment is imported: gymnax starts JAX
    env, params = jaxtrack.make()
    step = jax.jit(cores.share_out(jax.vmap(env.step, in_axes=(0, 0, 0, None)), shared=1))

What is shared out gives what one core gives, but for rounding.
"""

import contextlib
import os
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import AxisType, PartitionSpec

_AXIS = "cores"


def available() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use(number: int | None = None) -> int:
    """Makes `number` cores a device each, and returns how many devices there are.

    Without a number, as many as `JAX_NUM_CPU_DEVICES` says, or all. Without effect once JAX has
    started, and on other devices than CPUs.
    """
    if number is None and "JAX_NUM_CPU_DEVICES" not in os.environ:
        number = available()
    if number is not None:
        with contextlib.suppress(RuntimeError):  # raised once JAX has started
            jax.config.update("jax_num_cpu_devices", number)
    return jax.device_count()


def share_out(function: Callable[..., Any], shared: int = 0) -> Callable[..., Any]:
    """`function` of arrays with rows, run on every device with its part of the rows.

    Args:
        function: takes and returns pytrees of arrays `[B, ...]`; rows must not influence one another.
        shared: number of arguments, from the last, that every device gets whole.

    Raises:
        ValueError: when it is called with a number of rows that the devices can not share equally.
    """

    def on_all_devices(*arguments: Any) -> Any:
        devices = jax.device_count()
        rows = {leaf.shape[0] for leaf in jax.tree.leaves(arguments[: len(arguments) - shared])}
        if len(rows) != 1 or min(rows) % devices:
            raise ValueError(
                f"rows = {sorted(rows)}: expected one multiple of the number of devices, {devices}"
            )
        mesh = jax.make_mesh((devices,), (_AXIS,), axis_types=(AxisType.Auto,))
        parts, whole = PartitionSpec(_AXIS), PartitionSpec()
        specs = (parts,) * (len(arguments) - shared) + (whole,) * shared
        # What the kernels of a CPU hold is not checked for being equal on all devices.
        mapped = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=parts, check_vma=False)
        return mapped(*arguments)

    return on_all_devices
