"""The records that flow through one step: truths, detections, tracks.

A variable number of things is a record of fixed size with a mask. Rows whose mask is
False hold meaningless numbers and never influence a row whose mask is True.

State order everywhere is Stone Soup's interleaved ``[x, vx, y, vy, z, vz]`` in metres and
metres per second, in the frame of the radar platform (x forward, y left, z up).
Detection order is Stone Soup's ``[elevation, bearing, range]`` in radians and metres.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxtrack.counts import Counts

Scalar = jax.Array | float
"""One number, traced or not."""

STATE_DIM = 6
DETECTION_DIM = 3
POSITION = (0, 2, 4)
VELOCITY = (1, 3, 5)

NO_DETECTION = -1
"""Value of an association or of `Tracks.updated_by` when no detection belongs to the track."""

NO_TRUTH = -1
"""Value of `Detections.truth` for clutter and for empty rows."""

NEVER = -1
"""Value of `Tracks.birth_step` in slots that never held a track."""


class Truths(struct.PyTreeNode):
    """True targets, capacity N.

    Attributes:
        state: `[N, 6]` positions (m) and velocities (m/s).
        alive: `[N]` whether the truth exists at this time.
    """

    state: jax.Array  # [N, 6]
    alive: jax.Array  # [N] bool


class Detections(struct.PyTreeNode):
    """What one look returned, capacity D.

    Attributes:
        value: `[D, 3]` elevation (rad), bearing (rad), range (m).
        active: `[D]` whether the row holds a detection.
        truth: `[D]` index of the truth that caused it, `NO_TRUTH` for clutter. Only the
            metrics may read it.
    """

    value: jax.Array  # [D, 3]
    active: jax.Array  # [D] bool
    truth: jax.Array  # [D] int

    @classmethod
    def from_values(cls, value: jax.Array, active: jax.Array | None = None) -> "Detections":
        """Wraps recorded detections `[D, 3]`; all rows count unless `active` says otherwise."""
        value = jnp.asarray(value, dtype=float)
        rows = value.shape[0]
        active = jnp.ones(rows, dtype=bool) if active is None else jnp.asarray(active)
        return cls(value=value, active=active, truth=jnp.full(rows, NO_TRUTH, dtype=int))

    @classmethod
    def none(cls, max_detections: int) -> "Detections":
        """No detections in `max_detections` rows."""
        rows = jnp.zeros(max_detections, dtype=bool)
        return cls.from_values(jnp.zeros((max_detections, DETECTION_DIM)), rows)


class Tracks(struct.PyTreeNode):
    """Track list, capacity T. A track keeps its slot for life.

    A track is identified by its birth step together with its birth detection.

    Attributes:
        mean: `[T, 6]` state estimate (m, m/s).
        covariance: `[T, 6, 6]` its covariance (m^2, m^2/s, m^2/s^2).
        active: `[T]` whether the slot holds a live track.
        updated_by: `[T]` index of the detection that updated or initiated the track on this
            step, else `NO_DETECTION`.
        birth_step: `[T]` step on which the track was initiated.
        birth_detection: `[T]` index, on that step, of the detection that initiated it.
        age: `[T]` steps since birth; 0 on the birth step.
        root: `[T, 6, 6]` factors L of the covariances, ``P = L L^T``; only with the covariance form
            `square_root`.
        counts: detections so far and time without one; only where a deleter or the initiator asks.
        tentative: the tentative tracks of the initiator `multi_measurement`, also T; else None.
    """

    mean: jax.Array  # [T, 6]
    covariance: jax.Array  # [T, 6, 6]
    active: jax.Array  # [T] bool
    updated_by: jax.Array  # [T] int
    birth_step: jax.Array  # [T] int
    birth_detection: jax.Array  # [T] int
    age: jax.Array  # [T] int
    root: jax.Array | None = None  # [T, 6, 6]
    counts: Counts | None = None
    tentative: "Tracks | None" = None

    @classmethod
    def empty(cls, max_tracks: int) -> "Tracks":
        """A track list without tracks, for the default tracker; for any other `lifecycle.no_tracks`."""
        return cls(
            mean=jnp.zeros((max_tracks, STATE_DIM)),
            covariance=jnp.zeros((max_tracks, STATE_DIM, STATE_DIM)),
            active=jnp.zeros(max_tracks, dtype=bool),
            updated_by=jnp.full(max_tracks, NO_DETECTION, dtype=int),
            birth_step=jnp.full(max_tracks, NEVER, dtype=int),
            birth_detection=jnp.full(max_tracks, NO_DETECTION, dtype=int),
            age=jnp.zeros(max_tracks, dtype=int),
        )


def position(state: jax.Array) -> jax.Array:
    """Positions `[..., 3]` (m) of states `[..., 6]`."""
    return state[..., 0::2]


def velocity(state: jax.Array) -> jax.Array:
    """Velocities `[..., 3]` (m/s) of states `[..., 6]`."""
    return state[..., 1::2]


def where_rows(mask: jax.Array, on_true: jax.Array, on_false: jax.Array) -> jax.Array:
    """Row-wise choice: `mask` `[R]`, values `[R, ...]`."""
    return jnp.where(mask.reshape(mask.shape + (1,) * (on_true.ndim - 1)), on_true, on_false)
