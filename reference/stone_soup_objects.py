"""A recorded episode as Stone Soup's objects, and Stone Soup's tracks and truths as our arrays.

found = to_stone_soup(record_episode(env, params, policy, key))
Plotter().plot_tracks(found.tracks, POSITION[:2])
"""

import dataclasses
import datetime
from collections.abc import Collection, Iterable, Iterator, Sequence

import jax
import numpy as np
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.state import StateMutableSequence
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from jaxtrack.recording import Episode
from jaxtrack.types import NO_DETECTION, STATE_DIM, Tracks
from reference.components import measurement_model, time_of
from reference.translate import (
    Estimate,
    TrackKey,
    as_vector,
    fill_slots,
    on_device,
    to_detections,
    to_ground_truth_paths,
    to_track_histories,
)

Times = Sequence[datetime.datetime]


@dataclasses.dataclass(frozen=True)
class StoneSoupObjects:
    """An episode of S steps as metric managers, plotters, trackers and writers take it.

    It is itself a source for all that `YAMLWriter` writes: iterated, it gives the last time with all
    tracks.

    Attributes:
        tracks: all tracks that ever lived, with their history; `id` is birth step and birth detection.
        groundtruth_paths: all truths that ever lived; `id` is the row.
        scans: `[S]` time of every step and its detections, as a tracker takes them from its detector;
            step k is k time steps after `components.EPOCH`.
    """

    tracks: set[Track]
    groundtruth_paths: set[GroundTruthPath]
    scans: list[tuple[datetime.datetime, set[Detection]]]

    @property
    def times(self) -> list[datetime.datetime]:
        """Time of every step."""
        return [time for time, _ in self.scans]

    @property
    def detections(self) -> set[Detection]:
        """Those of all steps."""
        return {detection for _, scan in self.scans for detection in scan}

    def __iter__(self) -> Iterator[tuple[datetime.datetime, set[Track]]]:
        """The last time with all tracks."""
        yield self.times[-1], self.tracks


def to_stone_soup(episode: Episode) -> StoneSoupObjects:
    """Everything of a recorded episode; its first record is step 1."""
    steps, params = range(1, len(episode) + 1), episode.params
    times = [time_of(step, params) for step in steps]
    model, found = measurement_model(params, exact_jacobian=False), episode.records.detections
    scans = [
        {one.metadata["index"]: one for one in to_detections(*scan, model)}
        for scan in zip(np.asarray(found.value, float), np.asarray(found.active), steps, times, strict=True)
    ]
    info = episode.records.tracker
    tracks = to_track_histories(episode.states.tracks, times, info.predicted if info else None, scans)
    paths = to_ground_truth_paths(episode.states.truths, times)
    return StoneSoupObjects(
        tracks=set(tracks.values()),
        groundtruth_paths=set(paths.values()),
        scans=[(time, set(scan.values())) for time, scan in zip(times, scans, strict=True)],
    )


def all_times(sequences: Iterable[StateMutableSequence]) -> list[datetime.datetime]:
    """Every time at which one of the tracks or paths has a state, rising."""
    return sorted({state.timestamp for sequence in sequences for state in sequence})


def to_trajectories(paths: Sequence[GroundTruthPath], times: Times | None = None) -> np.ndarray:
    """Paths as `Params.trajectories` `[K, N, 6]`, NaN where a path has no state.

    Args:
        paths: one for each row n, in order; states x, vx, y, vy, z, vz (m, m/s) in the platform's frame.
        times: of the rows k, one `time_step` apart to be replayed; unset, all times of the paths.

    Raises:
        ValueError: naming the path of which a state does not have six entries.
    """
    times = all_times(paths) if times is None else times
    trajectories = np.full((len(times), len(paths), STATE_DIM), np.nan)
    for row, path in enumerate(paths):
        states = {state.timestamp: as_vector(state.state_vector) for state in path}
        wrong = {len(state) for state in states.values()} - {STATE_DIM}
        if wrong:
            raise ValueError(f"paths[{row}]: states with {min(wrong)} entries; expected {STATE_DIM}")
        for step, time in enumerate(times):
            if time in states:
                trajectories[step, row] = states[time]
    return trajectories


def to_track_record(
    tracks: Iterable[Track], max_tracks: int, times: Times | None = None, first_step: int = 1
) -> Tracks:
    """Stone Soup's tracks as a record `[K, T, ...]`, in slots as our tracker would hold them.

    Args:
        tracks: with their whole history; all that are equally old are told apart by birth
            detection where it is numbered, else by state.
        max_tracks: number T of slots.
        times: of the rows k; unset, all times of the tracks.
        first_step: number of the step of row 0; an episode's is 1.

    Raises:
        ValueError: if more tracks than slots live at one time.
    """
    tracks = list(tracks)
    times = all_times(tracks) if times is None else times
    keys = number_tracks(tracks, {time: step for step, time in enumerate(times, start=first_step)})
    states = {track: {state.timestamp: state for state in track} for track in tracks}
    slots: list[Track | None] = [None] * max_tracks
    rows = []
    for step, time in enumerate(times, start=first_step):
        live = [track for track in keys if time in states[track]]
        if len(live) > max_tracks:
            raise ValueError(f"{len(live)} tracks at {time}: expected at most max_tracks = {max_tracks}")
        slots = take_slots(slots, live)
        held: list[Estimate | None] = [
            None if track is None else (states[track][time], keys[track], source(states[track][time]))
            for track in slots
        ]
        rows.append(fill_slots(held, step))
    return on_device(jax.tree.map(lambda *leaves: np.stack(leaves), *rows))


def number_tracks(tracks: Iterable[Track], steps: dict[datetime.datetime, int]) -> dict[Track, TrackKey]:
    """Key of every track that has a state on one of the steps, in order of birth.

    That of our own, which is in the metadata of the birth's detection; for others the first of the
    steps, and the place among those born on it.
    """
    keys: dict[Track, TrackKey] = {}
    born: dict[int, int] = {}
    for track in sorted(tracks, key=birth_order):
        known = [steps[state.timestamp] for state in track if state.timestamp in steps]
        if not known:
            continue
        own = birth_metadata(track)
        if "step" in own:
            keys[track] = own["step"], own["index"]
        else:
            keys[track] = known[0], born.get(known[0], 0)
            born[known[0]] = keys[track][1] + 1
    return keys


def take_slots(slots: Sequence[Track | None], live: Collection[Track]) -> list[Track | None]:
    """What the slots hold next: a track stays in its slot for life, new ones take the first free ones.

    New tracks go in the order of their births; those for which no slot is left wait.
    """
    slots = [track if track in live else None for track in slots]
    waiting = iter(sorted(set(live) - set(slots), key=birth_order))
    return [next(waiting, None) if track is None else track for track in slots]


def birth_order(track: Track) -> tuple:
    """Sorts tracks by time of birth, then by birth detection where it is numbered, then by state."""
    birth = track[0]
    return birth.timestamp, birth_metadata(track).get("index", 0), *as_vector(birth.state_vector)


def birth_metadata(track: Track) -> dict:
    """Metadata of the detection that a track was born from; empty where there is none."""
    detection = getattr(getattr(track[0], "hypothesis", None), "measurement", None)
    return getattr(detection, "metadata", None) or {}


def source(state: object) -> int:
    """Detection that updated a track: its index where it is numbered, else 0; or `NO_DETECTION`."""
    if not isinstance(state, Update):
        return NO_DETECTION
    detection = getattr(state.hypothesis, "measurement", None)
    return (getattr(detection, "metadata", None) or {}).get("index", 0)
