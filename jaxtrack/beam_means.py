"""The mean scan value in the beam of every look, for one map or for many at once."""

import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import custom_vmap

from jaxtrack.kernel import in_one_kernel
from jaxtrack.params import Params, StaticParams
from jaxtrack.scan_map import beam_weights

SMALL_SHARE = 96
"""A beam is small if it holds at most this part of the map's pixels."""
BAND_SHARE = 12
"""And if it crosses at most this part of its rows."""


class BeamPixels(struct.PyTreeNode):
    """The pixels in the beam of every look, if all beams are small.

    Attributes:
        pixel: `[A, P]` number of a pixel of the flat map.
        weight: `[A, P]` its part of the mean; 0 where a beam holds fewer than P.
        small: `[]` whether all beams are small; if not, the others are of no use.
    """

    pixel: jax.Array
    weight: jax.Array
    small: jax.Array


def beam_means(static: StaticParams, params: Params) -> Callable[[jax.Array], jax.Array]:
    """The function of a map `[M, M]` that gives the mean scan value in the beam of every look `[L * L]`.

    `beam_weights` times the map; where beams are small, only their pixels are multiplied. `jax.vmap` over
    maps is fastest if they are stored as `[M, M, B]`, the scenarios last.
    """
    pixels = beam_pixels(static, params)

    def of_maps(scan_maps: jax.Array, pixels: BeamPixels, params: Params) -> jax.Array:
        flat = scan_maps.reshape(-1, scan_maps.shape[-1])
        return jax.lax.cond(
            pixels.small,
            lambda: _of_pixels(flat, pixels),
            # The matrix is made anew: a loop around a branch would copy it at every turn.
            lambda: beam_weights(static, params) @ flat,
        )

    together = _batched_last(of_maps) if jax.default_backend() == "cpu" else of_maps
    return lambda scan_map: together(scan_map[..., None], pixels, params)[..., 0]


def beam_pixels(static: StaticParams, params: Params) -> BeamPixels:
    """The pixels in the beams of all looks; of those of one elevation, from the same few rows of the map."""
    looks, size = static.num_looks, static.map_size
    height, most = -(-size // BAND_SHARE), -(-(size**2) // SMALL_SHARE)
    # Elevation, azimuth, row, column.
    grid = jnp.swapaxes(beam_weights(static, params).reshape(looks, looks, size, size), 0, 1)
    crossed = jnp.any(grid > 0, axis=(1, 3))
    first = jnp.minimum(jnp.argmax(crossed, axis=1), size - height)
    bands = jax.vmap(lambda grid, first: jax.lax.dynamic_slice_in_dim(grid, first, height, 1))(grid, first)
    bands = bands.reshape(looks, looks, -1)
    most = min(most, bands.shape[-1])
    place = jnp.argsort(bands == 0, axis=-1, stable=True)[..., :most]
    weight = jnp.take_along_axis(bands, place, axis=-1)
    pixel = first[:, None, None] * size + place

    def by_look(rows: jax.Array) -> jax.Array:
        return jnp.swapaxes(rows, 0, 1).reshape(looks**2, -1)

    return BeamPixels(by_look(pixel), by_look(weight), jnp.sum(weight > 0) == jnp.sum(grid > 0))


def _of_pixels(maps: jax.Array, pixels: BeamPixels) -> jax.Array:
    """Means `[A, B]` of flat maps `[M * M, B]`: look by look, the scenarios at once."""
    if maps.shape[1] == 1:
        return jnp.sum(pixels.weight * maps[pixels.pixel, 0], axis=1)[:, None]

    def of_looks(maps: jax.Array, pixel: jax.Array, weight: jax.Array) -> jax.Array:
        def of_look(row: tuple[jax.Array, jax.Array]) -> jax.Array:
            terms = (
                weight * jax.lax.dynamic_index_in_dim(maps, pixel, keepdims=False)
                for pixel, weight in zip(*map(jnp.unstack, row), strict=True)
            )
            return functools.reduce(operator.add, terms)

        return jax.lax.map(of_look, (pixel, weight))

    return in_one_kernel(of_looks, maps, pixels.pixel, pixels.weight)


def _batched_last(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """`function` of maps `[M, M, B]`, to which `jax.vmap` hands more of them along the last axis."""
    batched_last = custom_vmap(function)

    @batched_last.def_vmap
    def rule(size: int, batched: list[Any], maps: jax.Array, *others: Any) -> tuple[jax.Array, bool]:
        if any(jax.tree.leaves(batched[1:])):
            axes = jax.tree.map(lambda each: 0 if each else None, tuple(batched))
            return jax.vmap(function, in_axes=axes)(maps, *others), True
        merged = jnp.moveaxis(maps, 0, 2).reshape(*maps.shape[1:3], -1)
        means = batched_last(merged, *others)
        return jnp.moveaxis(means.reshape(-1, size, maps.shape[-1]), 1, 0), True

    return batched_last
