"""Devices that share one training: each steps its part of the environments and learns from them.

The weights are the same everywhere: what the devices find in their own samples is added up before
each step of the optimiser, so that their number changes nothing but rounding. A device is a core of
the CPU (`jaxtrack.cores`) or an accelerator.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from train.config import TrainConfig

_AXIS = "devices"
_PARTS, _WHOLE = PartitionSpec(_AXIS), PartitionSpec()


class Share(NamedTuple):
    """What one device does of a training.

    Attributes:
        number: devices that share it; 1 does all of it, and needs no other.
    """

    number: int = 1

    def own(self, rows: jax.Array, axis: int = 0) -> jax.Array:
        """Of rows along an axis that all devices have, this one's part."""
        if self.number == 1:
            return rows
        return jnp.stack(jnp.split(rows, self.number, axis))[jax.lax.axis_index(_AXIS)]

    def all(self, parts: Any, axis: int = 0) -> Any:
        """Arrays with the rows of all devices along an axis, the inverse of `own`."""
        if self.number == 1:
            return parts
        return jax.tree.map(lambda leaf: jax.lax.all_gather(leaf, _AXIS, axis=axis, tiled=True), parts)

    def add(self, part: jax.Array) -> jax.Array:
        """Sum of an array over all devices."""
        if self.number == 1:
            return part
        total: jax.Array = jax.lax.psum(part, _AXIS)
        return total


ALONE = Share()


def with_devices(config: TrainConfig) -> TrainConfig:
    """The configuration with its number of devices: all that there are, as far as they can share equally.

    Raises:
        ValueError: if it wants more than there are.
    """
    there = jax.device_count()
    if config.devices > there:
        raise ValueError(
            f"devices = {config.devices}: expected at most {there}, as many as JAX has here; in front of the "
            f"command, JAX_NUM_CPU_DEVICES={config.devices} makes as many of a CPU, whatever its cores"
        )
    if config.devices:
        return config
    largest = max(number for number in range(1, there + 1) if config.shares_equally(number))
    return dataclasses.replace(config, devices=largest)


def share_out(step: Callable[[Any], Any], divided: Any, number: int) -> Callable[[Any], Any]:
    """A step of a training on several devices.

    Args:
        step: from a state to the next one and its metrics, on each device with its own environments.
        divided: the state's tree, with True for arrays whose rows are environments.
        number: of devices.
    """
    if number == 1:
        return step
    parts = jax.tree.map(lambda rows: _PARTS if rows else _WHOLE, divided)
    # What the kernels of a CPU hold is not checked for being equal on all devices.
    result: Callable[[Any], Any] = jax.shard_map(
        step, mesh=_mesh(number), in_specs=(parts,), out_specs=(parts, _WHOLE), check_vma=False
    )
    return result


def places(divided: Any, number: int) -> Any:
    """Where the arrays of the state lie: the sharding of each, for `jax.device_put`."""
    mesh = _mesh(number)
    return jax.tree.map(lambda rows: NamedSharding(mesh, _PARTS if rows else _WHOLE), divided)


def _mesh(number: int) -> Mesh:
    return jax.make_mesh((number,), (_AXIS,), axis_types=(AxisType.Auto,), devices=jax.devices()[:number])
