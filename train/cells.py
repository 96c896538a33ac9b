"""The per-cell policy: the same small network looks at every cell of the field.

For each look a few features of what its beam holds are computed from the observation, with
the geometry known instead of learned. One softmax over all looks decides.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from jaxtrack.models import direction
from jaxtrack.observation import Observation
from jaxtrack.params import Params, StaticParams
from jaxtrack.scan_map import beam_means, look_grid
from jaxtrack.sensor import in_beam

LOGIT_SCALE = 10.0
"""Good looks differ from poor ones by a few hundredths of a scan value: small weights must
be able to tell them apart by several nats, or the policy stays almost uniform."""


class CellInputs(struct.PyTreeNode):
    """What the per-cell network reads, K = L * L cells.

    Attributes:
        cells: `[..., K, 5]` mean scan value in the beam; number of tracks in it; sum and
            maximum of their covariance norms (per deletion threshold); closeness of the
            nearest track to the boresight, 1 on it and 0 a beam width away.
        context: `[..., 3]` share of slots in use, mean scan value, mean covariance norm.
    """

    cells: jax.Array  # [..., K, 5]
    context: jax.Array  # [..., 3]


class CellGeometry:
    """Turns observations into `CellInputs`; holds what is fixed by the parameters."""

    def __init__(self, static: StaticParams, params: Params) -> None:
        self.params = params
        self.looks = look_grid(static, params)
        self.boresights = direction(self.looks[:, 0], self.looks[:, 1])
        self.scan_values = beam_means(static, params)

    def __call__(self, observation: Observation) -> CellInputs:
        """Inputs of one observation (no batch dimension)."""
        tracks, mask = observation["tracks"], observation["mask"]
        # Empty rows may hold anything: replace them before any arithmetic.
        tracks = jnp.where(mask[:, None], tracks, 0.0)
        angles = tracks[:, 1:3] * self.params.field_limit
        towards = direction(angles[:, 0], angles[:, 1])
        norm = tracks[:, 6]

        inside = jax.vmap(in_beam, in_axes=(None, 0, None))(towards, self.looks, self.params)
        inside = jnp.where(mask, inside, False)
        chord = jnp.sqrt(jnp.maximum(2 - 2 * self.boresights @ towards.T, 0.0))
        closeness = jnp.clip(1 - chord / self.params.beam_azimuth, 0.0, 1.0)
        scan_value = self.scan_values(observation["scan_map"])
        cells = jnp.stack(
            [
                scan_value,
                inside.sum(axis=-1),
                inside @ norm,
                jnp.where(inside, norm, 0.0).max(axis=-1),
                jnp.where(mask, closeness, 0.0).max(axis=-1),
            ],
            axis=-1,
        )
        share = mask.mean()
        mean_norm = norm.sum() / jnp.maximum(mask.sum(), 1)
        context = jnp.stack([share, observation["scan_map"].mean(), mean_norm])
        return CellInputs(cells=cells, context=context)


class CellNetwork(nn.Module):
    """Two shared dense layers on every cell; a logit per cell; a value from pooled cells."""

    width: int = 32

    @nn.compact
    def __call__(self, inputs: CellInputs) -> tuple[jax.Array, jax.Array]:
        """Logits `[..., K]` over the looks (azimuth index first) and value `[...]`."""
        gain = nn.initializers.orthogonal(2**0.5)
        context = nn.Dense(self.width, kernel_init=gain, name="context")(inputs.context)
        hidden = nn.Dense(self.width, kernel_init=gain, use_bias=False, name="cells")(inputs.cells)
        hidden = nn.relu(hidden + context[..., None, :])
        hidden = nn.relu(nn.Dense(self.width, kernel_init=gain, name="hidden")(hidden))
        small = nn.initializers.orthogonal(0.01)
        logits = LOGIT_SCALE * nn.Dense(1, kernel_init=small, name="logit")(hidden)[..., 0]
        pooled = jnp.concatenate([hidden.mean(axis=-2), hidden.max(axis=-2), inputs.context], axis=-1)
        pooled = nn.relu(nn.Dense(2 * self.width, kernel_init=gain, name="pooled")(pooled))
        value = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0), name="value")(pooled)
        return logits, value[..., 0]
