"""The scan map: how likely something changed in each direction since the last look there.

The paper names a scan value without a formula (it points to arXiv 2502.13584). Ours is
``1 - exp(-(t - t_last look) / tau)``: 1 where never seen, 0 inside the dwell just made.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxtrack.kernel import stage
from jaxtrack.models import direction
from jaxtrack.params import Params, StaticParams
from jaxtrack.sensor import in_beam, look_angles

BAND_SHARE = 12
"""`beam_means` takes the short way if no beam crosses more than this part of the map's rows."""


def initial_scan_map(static: StaticParams) -> jax.Array:
    """Map `[M, M]` of a field never seen. Row is elevation, column is azimuth, both rising."""
    return jnp.ones((static.map_size, static.map_size))


def update_scan_map(scan_map: jax.Array, look: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Ages the map `[M, M]` by one time step and clears the dwell of a look `[2]` (rad)."""
    aged = 1 - (1 - scan_map) * jnp.exp(-params.time_step / params.scan_time_constant)
    return jnp.where(pixels_in_beam(look, static, params), 0.0, aged)


def mean_scan_value(scan_map: jax.Array) -> jax.Array:
    """Mean `[]` of a map `[M, M]`."""
    # Rows first: neighbouring numbers can be added at once, a single sum goes one by one.
    return jnp.mean(jnp.mean(scan_map, axis=0))


def pixels_in_beam(look: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """`[M, M]` whether a pixel lies in the beam of a look `[2]` (rad): `in_beam` of `pixel_directions`.

    Of a grid only the angles of its rows and columns need sines and cosines.
    """
    ahead, aside, sine, cosine = _grid_directions(grid_angles(static, params), look[0])
    look_sine, look_cosine = jnp.sin(look[1]), jnp.cos(look[1])
    forward = cosine[:, None] * ahead
    x = look_cosine * forward + (look_sine * sine)[:, None]
    y = cosine[:, None] * aside
    z = (look_cosine * sine)[:, None] - look_sine * forward
    half_bearing, half_elevation = params.beam_azimuth / 2, params.beam_elevation / 2
    in_bearing = jnp.abs(y) * jnp.cos(half_bearing) <= jnp.sin(half_bearing) * x
    return in_bearing & (jnp.abs(z) <= jnp.sin(half_elevation))


@stage
def _grid_directions(angles: jax.Array, azimuth: jax.Array) -> tuple[jax.Array, ...]:
    """Of columns: cosine and sine `[M]` of the azimuth less the look's. Of rows: sine and cosine `[M]`."""
    return jnp.cos(angles - azimuth), jnp.sin(angles - azimuth), jnp.sin(angles), jnp.cos(angles)


def grid_angles(static: StaticParams, params: Params) -> jax.Array:
    """Angles `[M]` (rad) of the map's rows and columns; the outermost lie on the edge of the field."""
    return params.field_limit * jnp.linspace(-1.0, 1.0, static.map_size)


def pixel_directions(static: StaticParams, params: Params) -> jax.Array:
    """Unit vectors `[M, M, 3]` of the pixels."""
    angles = grid_angles(static, params)
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


def beam_sizes(static: StaticParams, params: Params) -> jax.Array:
    """Number `[L * L]` of pixels in the beam of every look."""
    return jnp.sum(beam_weights(static, params) > 0, axis=1)


def beam_means(static: StaticParams, params: Params) -> Callable[[jax.Array], jax.Array]:
    """The function of a map `[M, M]` that gives the mean scan value in the beam of every look `[L * L]`.

    `beam_weights` times the map. A beam crosses few rows of the map, the same for all looks of
    one elevation: where they are at most a twelfth, only those are multiplied.
    """
    looks, pixels = static.num_looks, static.map_size
    height = -(-pixels // BAND_SHARE)
    # Elevation, azimuth, row, column.
    grid = jnp.swapaxes(beam_weights(static, params).reshape(looks, looks, pixels, pixels), 0, 1)
    crossed = jnp.any(grid > 0, axis=(1, 3))
    first = jnp.minimum(jnp.argmax(crossed, axis=1), pixels - height)

    def band(matrix: jax.Array, first: jax.Array, axis: int) -> jax.Array:
        return jax.lax.dynamic_slice_in_dim(matrix, first, height, axis)

    enough = jnp.sum(jax.vmap(band, in_axes=(0, 0, None))(crossed, first, 0)) == jnp.sum(crossed)
    weights = jax.vmap(band, in_axes=(0, 0, None))(grid, first, 1).reshape(looks, looks, -1)
    bands = list(zip(jnp.unstack(weights), jnp.unstack(first), strict=True))

    def of_crossed_rows(scan_map: jax.Array) -> jax.Array:
        means = [weights @ band(scan_map, first, 0).ravel() for weights, first in bands]
        return jnp.stack(means, axis=1).ravel()

    def of_all_rows(scan_map: jax.Array) -> jax.Array:
        # The matrix is made anew: a loop around a branch would copy it at every turn.
        return beam_weights(static, params) @ scan_map.ravel()

    return lambda scan_map: jax.lax.cond(enough, of_crossed_rows, of_all_rows, scan_map)
