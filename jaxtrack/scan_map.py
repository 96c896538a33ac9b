"""The scan map: how likely something changed in each direction since the last look there.

The paper names a scan value without a formula (it points to arXiv 2502.13584). Ours is
``1 - exp(-(t - t_last look) / tau)``: 1 where never seen, 0 inside the dwell just made.
"""

import jax
import jax.numpy as jnp

from jaxtrack.kernel import add_up, stage
from jaxtrack.models import direction
from jaxtrack.params import Params, StaticParams
from jaxtrack.sensor import in_beam, look_angles


def initial_scan_map(static: StaticParams) -> jax.Array:
    """Map `[M, M]` of a field never seen. Row is elevation, column is azimuth, both rising."""
    return jnp.ones((static.map_size, static.map_size))


def update_scan_map(scan_map: jax.Array, look: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """Ages the map `[M, M]` by one time step and clears the dwell of a look `[2]` (rad)."""
    aged = 1 - (1 - scan_map) * jnp.exp(-params.time_step / params.scan_time_constant)
    return jnp.where(pixels_in_beam(look, static, params), 0.0, aged)


def mean_scan_value(scan_map: jax.Array, sharpness: int = 1) -> jax.Array:
    """Mean `[]` of a map `[M, M]`, or of this power of its values."""
    # Rows first: neighbouring numbers can be added at once, a single sum goes one by one.
    if sharpness == 1:
        return jnp.mean(jnp.mean(scan_map, axis=0))
    # XLA would take the powers one by one before a sum over rows, but not before a chain of sums.
    rows = scan_map.shape[0] if scan_map.shape[0] % 2 else scan_map.shape[0] // 2
    return jnp.mean(add_up((scan_map**sharpness).reshape(rows, -1))) / rows


def pixels_in_beam(look: jax.Array, static: StaticParams, params: Params) -> jax.Array:
    """`[M, M]` whether a pixel lies in the beam of a look `[2]` (rad): `in_beam` of `pixel_directions`.

    Of a grid only the angles of its rows and columns need sines and cosines, and every pixel two products.
    """
    cosine, height, margin, lift, drop = _edges(grid_angles(static, params), look, params)
    cosine, height, lift = cosine[:, None], height[:, None], lift[:, None]
    in_bearing = cosine * margin <= height
    return in_bearing & (jnp.abs(lift - cosine * drop) <= jnp.sin(params.beam_elevation / 2))


@stage
def _edges(angles: jax.Array, look: jax.Array, params: Params) -> tuple[jax.Array, ...]:
    """What the edges of a beam need of rows and columns.

    In the frame of the beam, with c and s the cosine and sine of a row's elevation, a pixel lies at
    ``x = cos(look) c ahead + sin(look) s``, ``y = c aside``, ``z = cos(look) s - sin(look) c ahead``.
    Inside are ``|y| cos(half) <= x sin(half)`` and ``|z| <= sin(half)``.

    Returns:
        Of rows `[M]` c, the part of x sin(half) without c, and that of z; of columns the parts with c of
        ``|y| cos(half) - x sin(half)`` and of -z.
    """
    # The grid has the same angles along both axes.
    sine, cosine = _sine_and_cosine(angles)
    (azimuth_sine, look_sine), (azimuth_cosine, look_cosine) = _sine_and_cosine(look)
    ahead = azimuth_cosine * cosine + azimuth_sine * sine
    aside = azimuth_cosine * sine - azimuth_sine * cosine
    half = params.beam_azimuth / 2
    margin = jnp.abs(aside) * jnp.cos(half) - look_cosine * ahead * jnp.sin(half)
    return cosine, look_sine * sine * jnp.sin(half), margin, look_cosine * sine, look_sine * ahead


@stage
def _sine_and_cosine(angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A stage: a look's would be worked out anew for every row and column."""
    return jnp.sin(angles), jnp.cos(angles)


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
