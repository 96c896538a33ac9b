"""The paper's actor-critic: NatureCNN and a track-list encoder, then separate MLPs.

A network here is any object with ``init(key, observation)`` and ``apply(variables,
observation) -> (logits, value)``, beside the distribution that its logits belong to.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from train.beams import HEAD_GAIN, TrackRows, logits_of_looks
from train.encoders import AttentionEncoder, BiGRUEncoder, FlattenEncoder
from train.orthogonal import orthogonal
from train.vision import GAIN, NatureCNN

ENCODERS: dict[str, type[nn.Module]] = {
    "flatten": FlattenEncoder,
    "bigru": BiGRUEncoder,
    "mhsa": AttentionEncoder,
}
"""Track-list encoders by the name used on the command line."""

ANY_LENGTH = ("bigru", "mhsa")
"""Those that take a track list of any length, and to which empty slots at its end make no difference."""


HEADS = ("beams", "joint", "factored", "gaussian")
"""How a network of the paper chooses a look, by the name used on the command line."""


class PaperNetwork(nn.Module):
    """Shared features, then an MLP 2 x 128 for the policy and another for the value.

    The paper trains with Stable Baselines3's `MultiInputPolicy`, so this has its structure:
    one feature extractor for both, no layer shared after it, tanh (bounded, so that early
    updates stay small), orthogonal initialisation with gain sqrt(2), 0.01 for the policy head
    (the first policy is almost uniform) and 1 for the value head.

    The paper's head is "factored": azimuth and elevation each on their own
    (`train.distributions.FACTORED`). "joint" is one softmax over all looks, and "beams" makes their
    logits from prices of what they search and from urgencies of the tracks in their beams, in the light
    of the beams' context too (`train.beams`); both are `train.distributions.JOINT`. "gaussian" is for
    continuous actions: the moments of azimuth and elevation (`train.distributions.Gaussian`).
    """

    encoder: str = "mhsa"
    """One of `ENCODERS`."""
    head: str = "factored"
    """One of `HEADS`."""
    num_looks: int = 19
    """Looks L along each axis."""
    width: int = 128
    """Width of both hidden layers of both MLPs."""

    @nn.compact
    def __call__(self, observation: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        """Policy and value of a batch of observations.

        Args:
            observation: `tracks` `[B, T, F]`, `mask` `[B, T]`, `scan_map` `[B, M, M]`, and for the head
                "beams" the `BeamInputs` as `beams`.

        Returns:
            Logits `[B, 2, L]` of azimuth and elevation index, `[B, L * L]` of all looks, or `[B, 2, 2]`
            moments of azimuth and elevation; and values `[B]`.

        Raises:
            ValueError: if `encoder` is not a name in `ENCODERS`, or `head` none in `HEADS`.
        """
        if self.encoder not in ENCODERS:
            raise ValueError(f"encoder = {self.encoder!r}: expected one of {', '.join(ENCODERS)}")
        if self.head not in HEADS:
            raise ValueError(f"head = {self.head!r}: expected one of {', '.join(HEADS)}")
        z_sh = NatureCNN(name="scan_map")(observation["scan_map"])
        z_tl = ENCODERS[self.encoder](name="track_list")(observation["tracks"], observation["mask"])
        # What is known of all tracks, such as whether they are enough, comes to this head unencoded.
        known = [observation["beams"].context] if self.head == "beams" else []
        z = jnp.concatenate([z_sh, z_tl, *known], axis=-1)
        value = MLP((self.width, self.width), 1, 1.0, name="value")(z)
        return self._logits(z, observation), value[..., 0]

    def _logits(self, z: jax.Array, observation: dict[str, Any]) -> jax.Array:
        def policy(outputs: int) -> jax.Array:
            result: jax.Array = MLP((self.width, self.width), outputs, HEAD_GAIN, name="policy")(z)
            return result

        if self.head == "factored":
            return policy(2 * self.num_looks).reshape(-1, 2, self.num_looks)
        if self.head == "gaussian":
            return policy(4).reshape(-1, 2, 2)
        if self.head == "joint":
            return policy(self.num_looks**2)
        beams = observation["beams"]
        urgencies, _ = TrackRows(name="rows")(beams, z)
        return logits_of_looks(policy(beams.search.shape[-2]), urgencies, beams)


class MLP(nn.Module):
    """Dense layers with tanh between them and a linear output."""

    widths: tuple[int, ...]
    outputs: int
    output_gain: float
    """Gain of the orthogonal initialisation of the output layer."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, F]` to `[B, outputs]`."""
        for width in self.widths:
            x = nn.tanh(nn.Dense(width, kernel_init=orthogonal(GAIN))(x))
        return nn.Dense(self.outputs, kernel_init=orthogonal(self.output_gain))(x)
