"""The beam policy: a look is worth what its beam would search plus what the tracks in it need.

It is the index rule with its numbers learned. The picture as a whole sets the prices of what
there is to search; a small network, the same for all tracks, says how urgent a look at each one
is. Which tracks lie in which beam is known from the geometry, not learned. One softmax over the
worths of all looks decides.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from jaxtrack.beam_means import beam_means
from jaxtrack.models import direction
from jaxtrack.observation import Observation, confirmed
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import removed_variance
from jaxtrack.scan_map import beam_sizes, look_grid
from jaxtrack.search_plan import search_plan
from jaxtrack.sensor import in_beams, look_number
from train.orthogonal import orthogonal

LOGIT_SCALE = 50.0
"""Good looks differ from poor ones by a few hundredths of a scan value: small weights must
be able to tell them apart by several nats, or the policy stays almost uniform."""

HEAD_GAIN = 0.01
"""Gain of the orthogonal initialisation of what makes logits: the first policy is almost uniform."""

NEVER_SEEN = 0.9999
"""Scan value above which a pixel counts as never looked at."""

SHARPNESS = 16
"""Power of every scan value that tells what was never seen from what was seen long ago."""

DANGER_EXPONENT = 8
"""Power of trace / deletion threshold that tells the tracks that are about to be deleted."""

REMOVED_SCALE = 0.1
"""Removed variance, per deletion threshold, that counts as 1."""


class BeamInputs(struct.PyTreeNode):
    """What the beam network reads, K = L * L looks.

    Attributes:
        search: `[..., 9, K]` of every look: mean scan value s in its beam; mean u of the scan values
            to the power of `SHARPNESS`; u times the root of a, and u times a, the pixels in the beam
            per largest number of them; mean n of u over the eight looks around it, 0 outside the
            field; u times n; its azimuth and elevation, per limit of the field; the largest u times root
            of a, at the look whose turn it is in the search plan alone.
        inside: `[..., T, K]` whether a track lies in the beam of a look.
        tracks: `[..., T, F]` the observation's features, the root of the covariance norm, s of the
            look nearest to the track, and where variances are observed: them and their roots, the
            variance that a detection would remove and its root, and the danger of deletion.
        mask: `[..., T]` where there is a track.
        context: `[..., 7]` share of slots in use; mean scan value; share of the field never seen;
            mean, mean root and maximum of the covariance norms; whether there are as many confirmed
            tracks as there can be truths (all count where variances are not observed).
    """

    search: jax.Array  # [..., 9, K]
    inside: jax.Array  # [..., T, K] bool
    tracks: jax.Array  # [..., T, F]
    mask: jax.Array  # [..., T] bool
    context: jax.Array  # [..., 7]

    def first_tracks(self, length: int) -> "BeamInputs":
        """The same with the first `length` slots for tracks."""
        cut: BeamInputs = self.replace(
            inside=self.inside[..., :length, :],
            tracks=self.tracks[..., :length, :],
            mask=self.mask[..., :length],
        )
        return cut


class BeamGeometry:
    """Turns observations into `BeamInputs`; holds what is fixed by the parameters."""

    def __init__(self, static: StaticParams, params: Params) -> None:
        self.static, self.params = static, params
        self.looks = look_grid(static, params)
        self.scan_values = beam_means(static, params)
        sizes = beam_sizes(static, params)
        self.areas = sizes / sizes.max()
        self.plan = search_plan(static, params)

    def __call__(self, observation: Observation) -> BeamInputs:
        """Inputs of one observation (no batch dimension)."""
        mask, scan_map = observation["mask"], observation["scan_map"]
        # Empty rows may hold anything: replace them before any arithmetic.
        tracks = jnp.where(mask[:, None], observation["tracks"], 0.0)
        angles, norm = tracks[:, 1:3] * self.params.field_limit, tracks[:, 6]
        towards = direction(angles[:, 0], angles[:, 1])
        scan_value, unseen = jax.vmap(self.scan_values)(jnp.stack([scan_map, scan_map**SHARPNESS]))
        nearest = jax.vmap(look_number, in_axes=(0, None, None))(angles, self.static, self.params)
        own = [tracks, jnp.sqrt(norm)[:, None], jnp.where(mask, scan_value[nearest], 0.0)[:, None]]
        sure = mask
        if "variances" in observation:
            variances = jnp.where(mask[:, None], observation["variances"], 0.0)
            own += [variances, jnp.sqrt(variances), self._needs(tracks[:, 0], variances)]
            sure = confirmed(mask, variances[:, 1] * self.params.deletion_threshold, self.params)
        return BeamInputs(
            search=self._search(scan_value, unseen),
            inside=in_beams(towards, self.looks, self.params) & mask[:, None],
            tracks=jnp.concatenate(own, axis=-1),
            mask=mask,
            context=self._context(norm, mask, sure, scan_map),
        )

    def _needs(self, distance: jax.Array, variances: jax.Array) -> jax.Array:
        threshold = self.params.deletion_threshold
        removed = removed_variance(variances[:, 0] * threshold, distance * self.params.max_range, self.params)
        removed /= REMOVED_SCALE * threshold
        danger = variances.sum(axis=-1) ** DANGER_EXPONENT
        return jnp.stack([removed, jnp.sqrt(removed), danger], axis=-1)

    def _search(self, scan_value: jax.Array, unseen: jax.Array) -> jax.Array:
        around = mean_of_neighbours(unseen.reshape(self.static.num_looks, -1)).ravel()
        places = self.looks.T / self.params.field_limit
        worth = unseen * jnp.sqrt(self.areas)
        planned = jnp.where(self.plan.next_look(unseen), jnp.max(worth), 0.0)
        own = [scan_value, unseen, worth, unseen * self.areas]
        return jnp.stack([*own, around, unseen * around, *places, planned])

    def _context(self, norm: jax.Array, mask: jax.Array, sure: jax.Array, scan_map: jax.Array) -> jax.Array:
        number = jnp.maximum(mask.sum(), 1)
        never_seen = (scan_map > NEVER_SEEN).mean()
        norms = [norm.sum() / number, jnp.sqrt(norm).sum() / number, norm.max()]
        complete = sure.sum() >= self.static.num_truths
        return jnp.stack([mask.mean(), scan_map.mean(), never_seen, *norms, complete.astype(norm.dtype)])


def mean_of_neighbours(grid: jax.Array) -> jax.Array:
    """Mean `[L, L]` over the eight neighbours of every place of a grid; outside it, all is 0."""
    padded = jnp.pad(grid, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:] - grid) / 8


class TrackRows(nn.Module):
    """A small network, the same for all tracks, that reads each of them in what is known of all."""

    width: int = 32

    @nn.compact
    def __call__(self, inputs: BeamInputs, context: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Urgencies `[..., T]` of a look at each track, and rows `[..., T, width]`; 0 where there is none.

        Args:
            inputs: the tracks.
            context: `[..., C]` what is known of all.
        """
        rows = _dense(self.width, "tracks")(inputs.tracks)
        rows += _dense(self.width, "context")(context)[..., None, :]
        rows = nn.relu(_dense(self.width, "hidden")(nn.relu(rows)))
        urgencies = _dense(1, "urgency", HEAD_GAIN)(rows)[..., 0]
        return jnp.where(inputs.mask, urgencies, 0.0), jnp.where(inputs.mask[..., None], rows, 0.0)


def logits_of_looks(prices: jax.Array, urgencies: jax.Array, inputs: BeamInputs) -> jax.Array:
    """Logits `[..., K]` of the looks, azimuth index first: worths of searching and of tracks in the beam.

    Args:
        prices: `[..., 9]` of the rows of `inputs.search`.
        urgencies: `[..., T]` of the tracks.
        inputs: what lies in which beam.
    """
    searched = jnp.einsum("...j,...jk->...k", prices, inputs.search)
    followed = jnp.sum(jnp.where(inputs.inside, urgencies[..., None], 0.0), axis=-2)
    return LOGIT_SCALE * (searched + followed)


class BeamNetwork(nn.Module):
    """Prices of searching from the whole picture, urgencies from every track, and a value."""

    width: int = 32

    @nn.compact
    def __call__(self, inputs: BeamInputs) -> tuple[jax.Array, jax.Array]:
        """Logits `[..., K]` over the looks (azimuth index first) and value `[...]`."""
        context = nn.relu(_dense(self.width, "context")(inputs.context))
        urgencies, rows = TrackRows(self.width, name="rows")(inputs, context)
        picture = jnp.concatenate([rows.mean(axis=-2), context], axis=-1)

        priced = nn.relu(_dense(self.width, "picture")(picture))
        prices = _dense(inputs.search.shape[-2], "prices", HEAD_GAIN)(priced)
        logits = logits_of_looks(prices, urgencies, inputs)
        valued = nn.relu(_dense(2 * self.width, "valued")(picture))
        return logits, _dense(1, "value", 1.0)(valued)[..., 0]


def _dense(features: int, name: str, gain: float = 2**0.5) -> nn.Dense:
    return nn.Dense(features, kernel_init=orthogonal(gain), name=name)
