"""The scan map: how likely something changed in each direction since the last look there.

The paper names a scan value without a formula (it points to arXiv 2502.13584). Ours is
``1 - exp(-(t - t_last look) / tau)``: 1 where never seen, 0 inside the dwell just made.
"""

import jax
import jax.numpy as jnp

from jaxtrack.models import direction
from jaxtrack.params import Params, StaticParams
from jaxtrack.sensor import in_beam, look_angles


def initial_scan_map(static: StaticParams) -> jax.Array:
    """Map `[M, M]` of a field never seen. Row is elevation, column is azimuth, both rising."""
    return jnp.ones((static.map_size, static.map_size))


def update_scan_map(scan_map: jax.Array, look: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Ages the map `[M, M]` by one time step and clears the dwell of a look `[2]` (rad)."""
    aged = 1 - (1 - scan_map) * jnp.exp(-params.time_step / params.scan_time_constant)
    return jnp.where(in_beam(pixel_directions(static, params), look, params), 0.0, aged)


def pixel_directions(static: StaticParams, params: Params) -> jax.Array:
    """Unit vectors `[M, M, 3]` of the pixels; the outermost lie on the edge of the field."""
    angles = params.field_limit * jnp.linspace(-1.0, 1.0, static.map_size)
    azimuth, elevation = jnp.meshgrid(angles, angles)
    return direction(azimuth, elevation)


def look_grid(static: StaticParams, params: Params) -> jax.Array:
    """Boresights `[L * L, 2]` (rad) of all discrete looks; look (i, j) is row ``i L + j``.

    i is the azimuth index and j the elevation index, as in the action.
    """
    index = jnp.arange(static.num_looks)
    azimuth, elevation = jnp.meshgrid(index, index, indexing="ij")
    actions = jnp.stack([azimuth.ravel(), elevation.ravel()], axis=-1)
    return look_angles(actions, StaticParams(num_looks=static.num_looks), params)


def beam_weights(static: StaticParams, params: Params) -> jax.Array:
    """Matrix `[L * L, M * M]`: times the flat map it gives the mean scan value in every beam."""
    pixels = pixel_directions(static, params).reshape(-1, 3)
    inside = jax.vmap(in_beam, in_axes=(None, 0, None))(pixels, look_grid(static, params), params)
    return inside / jnp.maximum(inside.sum(axis=-1, keepdims=True), 1)
