"""The tracker on recorded detections, as one function.

    recorded = RecordedDetections.from_scans(times, scans)
    for rows in track_scans(recorded, Params()):
        print(rows.track, rows.mean)

No track and no detection is ever left out: capacities follow what is recorded.
"""

import dataclasses
import time
from collections.abc import Generator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxtrack import tracker
from jaxtrack.detection_file import MICROSECONDS, RecordedDetections
from jaxtrack.lifecycle import no_tracks
from jaxtrack.params import Params, StaticParams
from jaxtrack.tracker import DEFAULT
from jaxtrack.types import STATE_DIM, Detections, Tracks

CHUNK = 256
"""Scans computed in one call."""
SMALLEST = 8
"""Smallest number of slots for tracks and for detections; all numbers are powers of two."""
CHUNK_BYTES = 64 * 10**6
"""Estimates kept of one call; where tracks are many, a call has fewer scans."""
PAIR_ARRAYS = 6
"""Numbers for each pair of track and detection that a step needs at once (measured)."""
MEMORY_LIMIT = 4 * 10**9
"""A scan whose pairs of tracks and detections need more is refused (bytes)."""
NO_TRACK = -1


@dataclasses.dataclass(frozen=True)
class TrackRows:
    """Live tracks after some consecutive scans, one row for each track and scan, R in all.

    Ordered by scan, then track; on the host.

    Attributes:
        scans: which scans these are, also those after which no track is alive.
        scan: `[R]` index of the scan.
        track: `[R]` number of the track: 0, 1, 2, ... in order of birth.
        mean: `[R, 6]` state estimate (m, m/s).
        covariance: `[R, 6, 6]` its covariance (m^2, m^2/s, m^2/s^2).
        detection: `[R]` row, within the scan, of the detection that updated or initiated the
            track, else `NO_DETECTION`.
        tracks_born: tracks born since the first scan of all.
        compile_seconds: time spent on compiling since the first scan of all (s).
    """

    scans: range
    scan: np.ndarray  # [R] int
    track: np.ndarray  # [R] int
    mean: np.ndarray  # [R, 6]
    covariance: np.ndarray  # [R, 6, 6]
    detection: np.ndarray  # [R] int
    tracks_born: int
    compile_seconds: float


class Numbered(struct.PyTreeNode):
    """The track list between two scans: live tracks first, in order of birth.

    So the order of the slots, which decides exact ties, depends on no capacity.

    Attributes:
        tracks: capacity T; tentative ones first in their list too.
        number: `[T]` number of each live track, else `NO_TRACK`.
        born: tracks born so far, the number of the next one.
    """

    tracks: Tracks
    number: jax.Array  # [T] int
    born: jax.Array  # [] int


class Scans(struct.PyTreeNode):
    """What one call computes: K scans with room for D detections each.

    Attributes:
        value: `[K, D, 3]` elevation, bearing (rad), range (m).
        active: `[K, D]` whether the row holds a detection.
        time_step: `[K]` time since the scan before (s).
        index: `[K]` number of the scan.
    """

    value: jax.Array
    active: jax.Array
    time_step: jax.Array
    index: jax.Array


def track_scans(
    recorded: RecordedDetections, params: Params, chunk: int = CHUNK, static: StaticParams = DEFAULT
) -> Generator[TrackRows, None, None]:
    """Runs the tracker over recorded detections; computes ahead of what was taken.

    In float64 (`jax_enable_x64`) the rows are Stone Soup's `MultiTargetTracker`'s to 1e-9
    standard deviations.

    Args:
        recorded: the detections of S scans; intervals may be uneven.
        params: numbers of the tracker; `time_step` is not used.
        chunk: scans in one call, so also in what is yielded; fewer where tracks are many.
        static: the parts that the tracker is made of; shapes are not read.

    Yields:
        Live tracks of the next scans, until all S are done.

    Raises:
        ValueError: if the pairs of detections and tracks of a scan need more than `MEMORY_LIMIT`, or the
            platform turns, as that is known at even steps only.
    """
    if params.platform_turn_rate is not None:
        raise ValueError(
            f"platform_turn_rate = {params.platform_turn_rate}: expected None with recorded scans"
        )
    state, done, rows, compile_seconds = _empty(SMALLEST, static), 0, None, 0.0
    after = state
    try:
        while done < len(recorded.time):
            batch = _batch(recorded, done, chunk, state)
            state = _resized(state, max(_slots(state), batch.active.shape[1]), static)
            _check_memory(recorded, batch, state)
            began = time.perf_counter()
            _run.lower(state, batch, params, static).compile()
            compile_seconds += time.perf_counter() - began
            after, made = _run(state, batch, params, static)
            if rows is not None:
                yield rows
                rows = None
            shortage = np.asarray(made.num_dropped)
            if shortage.any():
                # Again from the same state, as if the slots had been there from the start.
                state = _resized(state, _slots(state) + shortage[shortage > 0][0], static)
                continue
            stop = min(done + len(batch.index), len(recorded.time))
            rows = _rows(made, range(done, stop), int(after.born), compile_seconds)
            _check_finite(rows, recorded)
            state, done = _resized(after, _most_live(made), static), stop
        if rows is not None:
            yield rows
    finally:
        # What still computes when Python ends, after Ctrl-C, crashes it.
        jax.block_until_ready(after)


class Made(struct.PyTreeNode):
    """The track list after each scan of one call, as in `Tracks` and `Numbered` with a leading K.

    Attributes:
        num_dropped: `[K]` new tracks for which no slot was free.
        num_tentative: `[K]` tentative tracks, or None where there are none.
    """

    mean: jax.Array
    covariance: jax.Array
    active: jax.Array
    updated_by: jax.Array
    number: jax.Array
    num_dropped: jax.Array
    num_tentative: jax.Array | None


@partial(jax.jit, static_argnames="static")
def _run(state: Numbered, scans: Scans, params: Params, static: StaticParams) -> tuple[Numbered, Made]:
    return jax.lax.scan(lambda state, scan: _step(state, scan, params, static), state, scans)


def _step(state: Numbered, scan: Scans, params: Params, static: StaticParams) -> tuple[Numbered, Made]:
    """One scan; new tracks get their numbers, and the slots are put in order of birth."""
    detections = Detections.from_values(scan.value, scan.active)
    tracks, info = tracker.step(state.tracks, detections, scan.time_step, scan.index, params, static)
    number = jnp.where(info.initiated, state.born + jnp.cumsum(info.initiated) - 1, state.number)
    order = jnp.argsort(jnp.where(tracks.active, number, jnp.iinfo(number.dtype).max))
    tracks, tentative = tracks.replace(tentative=None), tracks.tentative
    tracks, number = jax.tree.map(lambda leaf: leaf[order], (tracks, number))
    num_tentative = None
    if tentative is not None:
        num_tentative, order = jnp.sum(tentative.active), jnp.argsort(~tentative.active)
        tracks = tracks.replace(tentative=jax.tree.map(lambda leaf: leaf[order], tentative))
    made = Made(
        tracks.mean,
        tracks.covariance,
        tracks.active,
        tracks.updated_by,
        number,
        info.num_dropped,
        num_tentative,
    )
    return Numbered(tracks, number, state.born + jnp.sum(info.initiated)), made


def _most_live(made: Made) -> int:
    """Slots that the fullest track list of a call needs, the tentative one included."""
    live = np.asarray(made.active).sum(axis=1).max()
    return int(live if made.num_tentative is None else max(live, np.asarray(made.num_tentative).max()))


def _empty(slots: int, static: StaticParams) -> Numbered:
    return Numbered(no_tracks(slots, static), jnp.full(slots, NO_TRACK, dtype=int), jnp.zeros((), dtype=int))


def _slots(state: Numbered) -> int:
    return state.number.shape[0]


def _resized(state: Numbered, slots: int, static: StaticParams) -> Numbered:
    """The same live tracks in the next power of two of slots, at least `SMALLEST`."""
    slots = _capacity(slots)
    if slots == _slots(state):
        return state

    def resize(leaf: jax.Array, empty: np.ndarray) -> np.ndarray:
        # In numpy: nothing to compile.
        rows = np.asarray(leaf)
        return np.concatenate([rows[:slots], empty[len(rows) :]]) if rows.ndim else rows

    return jax.tree.map(resize, state, jax.device_get(_empty(slots, static)))


def _capacity(number: int) -> int:
    return max(SMALLEST, 1 << (int(number) - 1).bit_length())


def _batch(recorded: RecordedDetections, first: int, chunk: int, state: Numbered) -> Scans:
    """The scans from `first` on, as many as one call takes; empty scans follow the last one."""
    bytes_each = _slots(state) * (STATE_DIM + 1) * STATE_DIM * 8
    length = int(np.clip(CHUNK_BYTES // bytes_each, 1, min(chunk, _capacity(len(recorded.time)))))
    stop = min(first + length, len(recorded.time))
    counts = recorded.count[first:stop]
    capacity = _capacity(counts.max())
    active = np.zeros((length, capacity), dtype=bool)
    active[: stop - first] = np.arange(capacity) < counts[:, None]
    value = np.zeros((length, capacity, 3))
    start = recorded.start[first]
    value[active] = recorded.value[start : start + counts.sum()]
    time_step = np.zeros(length)
    before = recorded.time[max(first - 1, 0)]
    time_step[: stop - first] = np.diff(recorded.time[first:stop], prepend=before) / MICROSECONDS
    arrays = (value, active, time_step, np.arange(first, first + length))
    return Scans(*(jnp.asarray(array) for array in arrays))


def _rows(made: Made, scans: range, tracks_born: int, compile_seconds: float) -> TrackRows:
    host = jax.device_get(made)
    scan, slot = np.nonzero(host.active[: len(scans)])
    return TrackRows(
        scans=scans,
        scan=scan + scans.start,
        track=host.number[scan, slot],
        mean=host.mean[scan, slot],
        covariance=host.covariance[scan, slot],
        detection=host.updated_by[scan, slot],
        tracks_born=tracks_born,
        compile_seconds=compile_seconds,
    )


def _check_memory(recorded: RecordedDetections, batch: Scans, state: Numbered) -> None:
    needed = _slots(state) * batch.active.shape[1] * PAIR_ARRAYS * 8
    if needed > MEMORY_LIMIT:
        first = int(batch.index[0])
        scan = first + int(recorded.count[first : first + len(batch.index)].argmax())
        raise ValueError(
            f"time {recorded.label[scan]}: {recorded.count[scan]} detections in one scan and "
            f"{_slots(state)} tracks need {needed / 1e9:.0f} GB; expected at most {MEMORY_LIMIT / 1e9:.0f} GB"
        )


def _check_finite(rows: TrackRows, recorded: RecordedDetections) -> None:
    wrong = ~np.isfinite(rows.mean).all(axis=1) | ~np.isfinite(rows.covariance).all(axis=(1, 2))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(
            f"time {recorded.label[rows.scan[row]]}, track {rows.track[row]}: its estimate is not finite; "
            "expected numbers of the tracker that suit the detections"
        )
