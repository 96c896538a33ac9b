"""Features of the cells on an observation made by hand; the network treats all cells alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from train.cells import CellGeometry, CellInputs, CellNetwork

L, M, T = 5, 9, 4
STATIC = StaticParams(max_tracks=T, map_size=M, num_looks=L)
# Looks lie 30 degrees apart, pixels 15 degrees; a beam reaches 0.3 rad = 17 degrees to each side.
PARAMS = Params(beam_azimuth=0.6, beam_elevation=0.6)
ON_TRACK, AZIMUTH_NEIGHBOUR, ELEVATION_NEIGHBOUR, CENTRE = 3 * L + 1, 2 * L + 1, 3 * L + 2, 2 * L + 2


def track(norm):
    """Features of a track on the boresight of look (3, 1): azimuth 30, elevation -30 degrees."""
    return [0.5, 0.5, -0.5, 0.1, 0.2, 0.3, norm]


def observe(*tracks, padding=0.0):
    """An observation with these tracks and a scan map that rises along both axes."""
    rows = np.full((T, 7), padding)
    rows[: len(tracks)] = np.reshape(tracks, (-1, 7))
    scan_map = np.arange(M * M).reshape(M, M) / (M * M)
    mask = np.arange(T) < len(tracks)
    return {"tracks": jnp.asarray(rows, dtype=float), "mask": mask, "scan_map": jnp.asarray(scan_map)}


@pytest.fixture(scope="module")
def features():
    """Observation to inputs, compiled."""
    return jax.jit(CellGeometry(STATIC, PARAMS))


def test_a_track_on_a_boresight_counts_there_and_is_near_its_neighbours(features):
    cells = np.asarray(features(observe(track(0.2))).cells)
    assert cells.shape == (L * L, 5)
    np.testing.assert_allclose(cells[ON_TRACK, 1:], [1, 0.2, 0.2, 1], atol=1e-6)
    others = np.delete(cells, ON_TRACK, axis=0)
    assert not others[:, 1:4].any()
    # Chords of 30 degrees: 2 sin(15) = 0.5176 up and down, and cos(-30) of it to the sides;
    # closeness is 1 - chord / 0.6.
    np.testing.assert_allclose(cells[ELEVATION_NEIGHBOUR, 4], 0.1373, atol=1e-4)
    np.testing.assert_allclose(cells[AZIMUTH_NEIGHBOUR, 4], 0.2529, atol=1e-4)
    assert np.count_nonzero(cells[:, 4]) == 5


def test_tracks_in_one_beam_add_up(features):
    cells = np.asarray(features(observe(track(0.2), track(0.3))).cells)
    np.testing.assert_allclose(cells[ON_TRACK, 1:], [2, 0.5, 0.3, 1], atol=1e-6)


def test_the_scan_value_is_the_mean_over_the_pixels_in_the_beam(features):
    observation = observe()
    scan_map = np.asarray(observation["scan_map"])
    cells = np.asarray(features(observation).cells)
    # The look straight ahead holds the middle pixel and its eight neighbours.
    np.testing.assert_allclose(cells[CENTRE, 0], scan_map[3:6, 3:6].mean(), rtol=1e-5)
    # Straight up by 30 degrees (row of pixels 6): higher rows, the same columns.
    assert cells[2 * L + 3, 0] > cells[CENTRE, 0] + 0.2
    # To the side by 30 degrees (column 6): two columns further, the same rows.
    np.testing.assert_allclose(cells[3 * L + 2, 0], scan_map[3:6, 5:8].mean(), rtol=1e-5)


def test_the_context_is_share_of_slots_mean_scan_value_and_mean_norm(features):
    context = features(observe(track(0.2), track(0.4), track(0.6))).context
    np.testing.assert_allclose(context, [3 / 4, 40 / 81, 0.4], rtol=1e-5)
    # 40/81 is the mean of 0..80 over 81. Without a track the mean norm is 0, not NaN.
    np.testing.assert_allclose(features(observe()).context, [0, 40 / 81, 0], rtol=1e-5)


def test_empty_rows_may_hold_anything(features):
    clean = features(observe(track(0.2)))
    for padding in (np.nan, np.inf, 0.5):
        jax.tree.map(np.testing.assert_array_equal, features(observe(track(0.2), padding=padding)), clean)


@pytest.fixture(scope="module")
def drawn():
    """A network with weights, and random inputs of three observations."""
    rng = np.random.default_rng(0)
    inputs = CellInputs(
        cells=jnp.asarray(rng.uniform(0, 1, (3, L * L, 5)), dtype=float),
        context=jnp.asarray(rng.uniform(0, 1, (3, 3)), dtype=float),
    )
    network = CellNetwork()
    weights = network.init(jax.random.key(0), inputs)
    return jax.jit(network.apply), weights, inputs


def test_every_cell_meets_the_same_network(drawn):
    apply, weights, inputs = drawn
    logits, value = apply(weights, inputs)
    assert logits.shape == (3, L * L)
    assert value.shape == (3,)
    order = np.random.default_rng(1).permutation(L * L)
    permuted_logits, permuted_value = apply(weights, inputs.replace(cells=inputs.cells[:, order]))
    np.testing.assert_allclose(permuted_logits, logits[:, order], atol=1e-5)
    np.testing.assert_allclose(permuted_value, value, atol=1e-5)
    assert np.ptp(logits, axis=1).min() > 1e-3


def test_a_cell_changes_its_own_logit_only_and_the_context_all(drawn):
    apply, weights, inputs = drawn
    logits, value = apply(weights, inputs)
    one, one_value = apply(weights, inputs.replace(cells=inputs.cells.at[:, 7].add(1.0)))
    changed = np.abs(one - logits) > 1e-6
    assert changed[:, 7].all()
    assert not np.delete(changed, 7, axis=1).any()
    assert (one_value != value).all()
    other, _ = apply(weights, inputs.replace(context=inputs.context + 1.0))
    assert (np.abs(other - logits) > 1e-6).all()
    # Observations of a batch do not mix.
    single, _ = apply(weights, jax.tree.map(lambda leaf: leaf[1], inputs))
    np.testing.assert_allclose(single, logits[1], atol=1e-5)
