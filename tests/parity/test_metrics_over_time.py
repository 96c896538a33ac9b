"""Metrics of whole records beside Stone Soup's generators."""

import jax
import numpy as np
import pytest
from stonesoup.measures import Euclidean
from stonesoup.types.state import GaussianState

from jaxtrack import Params, Truths, pcrb
from jaxtrack.types import POSITION
from reference.components import measurement_model, time_of
from reference.parity.compare import TOLERANCE, covariance_error
from reference.parity.metrics import COMPARISONS, compare, largest_error, metric_rows, our_numbers
from reference.parity.records import random_record
from reference.parity.scenes import AHEAD, random_means, random_tracks
from reference.parity.stock_metrics import StockRecord, pcrb_of_path, track_to_truth
from reference.translate import as_vector, to_ground_truth_paths, track_key

pytestmark = pytest.mark.usefixtures("quick_compilation")

EVENTS = ["break", "swap", "return", "dated back", "miss", "shared", "spurious", "replaced", "no track"]
EVENTS += ["no truth"]
NUMBERS = [
    {},
    {"gospa_switching_penalty": 30.0, "siap_confirm_steps": 2, "siap_end_steps": 3},
    {"gospa_order": 1.0, "gospa_cutoff": 80.0, "siap_threshold": 120.0, "siap_end_steps": 1},
    {"gospa_order": 3.0, "siap_confirm_steps": 4, "elevation_sigma": 1e-3, "process_noise": 5.0},
]


@pytest.fixture(scope="module")
def records():
    """Random records of one shape, with other numbers every time."""
    return [
        random_record(np.random.default_rng(seed), Params(**NUMBERS[seed % len(NUMBERS)]))
        for seed in range(16)
    ]


@pytest.mark.parametrize("comparison", COMPARISONS, ids=lambda one: one.component)
def test_metrics_over_records(comparison, records):
    row = compare(comparison, records)
    assert row.passed, row
    assert row.float32 < 1e-3
    assert row.ties <= len(records) / 4  # so that most rates of track number change were compared
    assert row.compared >= 3 * len(records)


def test_a_limit_spares_the_slow_ones(records):
    rows = list(metric_rows(records[:2], limit=1))
    assert [row.component for row in rows] == [one.component for one in COMPARISONS]
    assert all(row.passed for row in rows)
    for row, one in zip(rows, COMPARISONS, strict=True):
        assert row.compared == compare(one, records[: 1 if one.slow else 2]).compared


def test_everything_happens_in_the_random_records(records):
    seen = dict.fromkeys(EVENTS, 0)
    for record in records[:4]:
        stock = StockRecord(record)
        associations = list(
            track_to_truth(record.params).associate_tracks(
                set(stock.tracks.values()), set(stock.paths.values())
            )
        )
        pairs = [tuple(association.objects) for association in associations]
        by_track = [
            [association for association in associations if track in association.objects]
            for track in stock.tracks.values()
        ]
        by_truth = [
            [association for association in associations if path in association.objects]
            for path in stock.paths.values()
        ]
        for (track, path), association in zip(pairs, associations, strict=True):
            start, *_, end = association.time_range.key_times
            seen["break"] += end < min(track[-1].timestamp, path[-1].timestamp)
            seen["return"] += len(association.time_range.key_times) > 2
            steps = [time for time in stock.times if start <= time <= end and time in association.time_range]
            errors = [Euclidean(POSITION)(track[time], path[time]) for time in steps]
            seen["miss"] += max(errors) >= record.params.siap_threshold
        seen["swap"] += sum(len(found) > 1 for found in by_track)
        seen["spurious"] += sum(not found for found in by_track)
        seen["dated back"] += sum(overlap(stock, found) for found in by_track)
        seen["shared"] += sum(overlap(stock, found) for found in by_truth)
        active = record.tracks.active
        births = np.diff(record.tracks.birth_step, axis=0) != 0
        seen["replaced"] += int((births & active[1:] & active[:-1]).sum())
        seen["no track"] += int((active[:-2].any(axis=1) & ~active[1:-1].any(axis=1)).sum())
        seen["no truth"] += int((~record.truths.alive.any(axis=0)).sum())
    assert min(seen.values()) > 0, seen


def overlap(stock, associations):
    """Whether two of the associations hold at the same time."""
    counts = [sum(time in one.time_range for one in associations) for time in stock.times]
    return max(counts) > 1


def test_the_switching_penalty_is_paid_in_the_random_records(records):
    (comparison,) = (one for one in COMPARISONS if one.switching)
    found = our_numbers(comparison, records[1], double=True)["switching"]
    assert len(np.unique(np.round(found, 6))) > 4  # halves and wholes


def test_an_error_or_a_nan_of_ours_is_seen():
    theirs = {"a": np.array([1.0, np.nan, 300.0])}
    assert largest_error({"a": np.array([1.0, 5.0, 300.0])}, theirs) == 0.0
    assert largest_error({"a": np.array([1.5, 5.0, 300.0])}, theirs) == 0.5
    assert largest_error({"a": np.array([1.0, 5.0, 303.0])}, theirs) == pytest.approx(0.01)
    assert np.isnan(largest_error({"a": np.array([np.nan, 5.0, 300.0])}, theirs))


def everything(truths, tracks, times, params):
    """All numbers of all metrics of a record."""
    return {one.component: one.ours(truths, tracks, times, params) for one in COMPARISONS}


@pytest.fixture(scope="module")
def short_records():
    """Three small records, and the times of their steps."""
    records = [
        random_record(np.random.default_rng(seed), Params(gospa_switching_penalty=30.0), 30, 3, 4)
        for seed in range(3)
    ]
    return records, Params().time_step * np.arange(30)


def widened(leaf, rows, order):
    """Empty rows, NaN where the type has it, and all rows in another order."""
    empty = np.nan if leaf.dtype.kind == "f" else 0
    padding = np.full((len(leaf), rows, *leaf.shape[2:]), empty, leaf.dtype)
    return np.concatenate([leaf, padding], axis=1)[:, order]


def test_vmap_equals_a_loop_and_empty_rows_and_the_order_of_slots_change_nothing(short_records):
    records, times = short_records
    thresholds = np.array([60.0, 120.0, 200.0])
    wide = [
        (
            jax.tree.map(lambda leaf: widened(leaf, 2, slice(None)), record.truths),
            jax.tree.map(lambda leaf: widened(leaf, 3, [6, 2, 0, 4, 3, 5, 1]), record.tracks),
        )
        for record in records
    ]
    truths, tracks = jax.tree.map(lambda *leaves: np.stack(leaves), *wide)
    batch = records[0].params.replace(siap_threshold=thresholds)
    axes = jax.tree.map(lambda _: None, batch).replace(siap_threshold=0)
    together = jax.jit(jax.vmap(everything, in_axes=(0, 0, None, axes)))(truths, tracks, times, batch)
    bound = together["pcrb.bounds"]
    assert not any(np.any(leaf[:, :, 3:]) for leaf in bound.values())
    together["pcrb.bounds"] = {name: leaf[:, :, :3] for name, leaf in bound.items()}
    alone = jax.jit(everything)
    for row, record in enumerate(records):
        params = record.params.replace(siap_threshold=thresholds[row])
        expected = alone(record.truths, record.tracks, times, params)
        found = jax.tree.map(lambda leaf, row=row: leaf[row], together)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), found, expected)


def test_pcrb_with_another_prior_less_information_and_a_gap():
    rng = np.random.default_rng(3)
    params = Params(time_step=0.05)
    prior = random_tracks(rng, 1).covariance
    state = np.tile(random_means(rng, 1, AHEAD), (20, 1, 1))
    alive = np.ones((20, 1), dtype=bool)
    alive[5:9] = False
    truths = Truths(state, alive)
    times = [time_of(step, params) for step in range(20)]
    path = to_ground_truth_paths(truths, times)[0]
    model = measurement_model(params)
    theirs = pcrb_of_path(path, GaussianState(np.zeros((6, 1)), np.asarray(prior[0])), model, params, irf=0.3)
    ours = jax.jit(pcrb.bounds)(truths, params.time_step * np.arange(20), params, prior, 0.3)
    assert covariance_error(np.asarray(ours.covariance)[alive], theirs["inverse_j"]) < TOLERANCE
    np.testing.assert_allclose(ours.position[alive], theirs["position_RMSE"], rtol=TOLERANCE)
    np.testing.assert_allclose(ours.velocity[alive], theirs["velocity_RMSE"], rtol=TOLERANCE)


def test_tracks_and_truths_are_translated_whole(short_records):
    (record, *_), _ = short_records
    stock = StockRecord(record)
    tracks, truths = record.tracks, record.truths
    births = {
        (int(step), int(row))
        for step, row in zip(
            tracks.birth_step[tracks.active], tracks.birth_detection[tracks.active], strict=True
        )
    }
    assert stock.tracks.keys() == births
    assert sum(map(len, stock.tracks.values())) == tracks.active.sum()
    assert {key: track_key(track) for key, track in stock.tracks.items()} == {key: key for key in births}
    for track in stock.tracks.values():
        assert list(track.states) == sorted(track.states, key=lambda state: state.timestamp)
        for state in track:
            step = stock.steps[state.timestamp]
            match = np.all(np.nan_to_num(tracks.mean[step]) == as_vector(state.state_vector), axis=1)
            (slot,) = np.flatnonzero(match)
            assert (tracks.birth_step[step, slot], tracks.birth_detection[step, slot]) == track_key(track)
            np.testing.assert_array_equal(state.covar, tracks.covariance[step, slot])
    assert stock.paths.keys() == set(np.flatnonzero(truths.alive.any(axis=0)))
    for row, path in stock.paths.items():
        assert [stock.steps[state.timestamp] for state in path] == list(np.flatnonzero(truths.alive[:, row]))
        found = np.array([as_vector(state.state_vector) for state in path])
        np.testing.assert_array_equal(found, truths.state[truths.alive[:, row], row])
