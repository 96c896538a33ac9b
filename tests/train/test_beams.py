"""Features of the beams on an observation made by hand; the network treats tracks and beams alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.scan_map import beam_weights
from jaxtrack.search_plan import search_plan
from train.beams import BeamGeometry, BeamInputs, BeamNetwork, mean_of_neighbours

pytestmark = pytest.mark.usefixtures("quick_compilation")

L, M, T = 5, 9, 4
STATIC = StaticParams(num_truths=3, max_tracks=T, map_size=M, num_looks=L)
# Looks lie 30 degrees apart, pixels 15 degrees; a beam reaches 0.3 rad = 17 degrees to each side.
PARAMS = Params(beam_azimuth=0.6, beam_elevation=0.6)
ON_TRACK, CENTRE = 3 * L + 1, 2 * L + 2


def track(norm, azimuth=0.5):
    """Features of a track, by default on the boresight of look (3, 1): azimuth 30, elevation -30 degrees."""
    return [0.5, azimuth, -0.5, 0.1, 0.2, 0.3, norm]


def observe(*tracks, padding=0.0, seen=True):
    """An observation with these tracks and a scan map that rises along both axes, or is never seen."""
    rows = np.full((T, 7), padding)
    rows[: len(tracks)] = np.reshape(tracks, (-1, 7))
    scan_map = np.arange(M * M).reshape(M, M) / (M * M) if seen else np.ones((M, M))
    mask = np.arange(T) < len(tracks)
    return {"tracks": jnp.asarray(rows, dtype=float), "mask": mask, "scan_map": jnp.asarray(scan_map)}


@pytest.fixture(scope="module")
def features():
    """Observation to inputs, compiled."""
    return jax.jit(BeamGeometry(STATIC, PARAMS))


def test_a_track_lies_in_the_beams_that_hold_it(features):
    # The second one lies half way between looks (3, 1) and (2, 1), whose beams both reach it.
    inside = np.asarray(features(observe(track(0.2), track(0.3, azimuth=0.25))).inside)
    assert inside.shape == (T, L * L)
    assert np.flatnonzero(inside[0]).tolist() == [ON_TRACK]
    assert np.flatnonzero(inside[1]).tolist() == [2 * L + 1, ON_TRACK]
    assert not inside[2:].any()


def test_a_track_has_the_root_of_its_norm_and_the_scan_value_of_the_look_at_it(features):
    observation = observe(track(0.25))
    scan_map = np.asarray(observation["scan_map"])
    inputs = features(observation)
    np.testing.assert_allclose(inputs.tracks[0, :7], track(0.25), rtol=1e-6)
    # Look (3, 1) looks at the pixel of row 2 and column 6.
    np.testing.assert_allclose(inputs.tracks[0, 7:], [0.5, inputs.search[0, ON_TRACK]], rtol=1e-6)
    assert abs(inputs.tracks[0, 8] - scan_map[2, 6]) < 0.05
    assert not inputs.tracks[1:].any()


def test_observed_variances_and_their_roots_are_features(features):
    observation = observe(track(0.25), track(0.5))
    variances = jnp.array([[0.04, 0.09], [0.16, 0.25], [jnp.nan, 1.0], [1.0, 1.0]])
    wider = jax.jit(BeamGeometry(STATIC, PARAMS))({**observation, "variances": variances})
    np.testing.assert_array_equal(wider.tracks[:, :9], features(observation).tracks)
    np.testing.assert_allclose(
        wider.tracks[:2, 9:13], [[0.04, 0.09, 0.2, 0.3], [0.16, 0.25, 0.4, 0.5]], rtol=1e-5
    )
    # At 5 km a detection has a variance of 225 m^2: 2 (5000 m x 2 mrad)^2 + (5 m)^2; the tracks 200 and 800.
    removed = np.array([200**2 / (200 + 225), 800**2 / (800 + 225)]) / 500
    danger = np.array([0.13, 0.41]) ** 8
    np.testing.assert_allclose(wider.tracks[:2, 13:].T, [removed, np.sqrt(removed), danger], rtol=1e-4)
    assert not wider.tracks[2:].any()


def turns():
    """Turns of the looks in the search plan."""
    return np.asarray(jax.jit(search_plan, static_argnums=0)(STATIC, PARAMS).turn)


def test_what_a_beam_would_search(features):
    inputs = features(observe(seen=False))
    assert np.flatnonzero(inputs.search[-1]).tolist() == np.flatnonzero(turns() == 0).tolist()
    assert inputs.search[-1].max() == inputs.search[2].max()
    inputs = features(observe())
    scan, unseen, by_root, by_area, around, product, azimuth, elevation, planned = np.asarray(inputs.search)
    assert np.count_nonzero(planned) == 1
    assert planned.max() == by_root.max()
    scan_map = np.asarray(observe()["scan_map"])
    # The look straight ahead holds the middle pixel and its eight neighbours.
    np.testing.assert_allclose(scan[CENTRE], scan_map[3:6, 3:6].mean(), rtol=1e-5)
    np.testing.assert_allclose(unseen[CENTRE], (scan_map[3:6, 3:6] ** 16).mean(), rtol=1e-5)
    np.testing.assert_allclose(product, unseen * around, rtol=1e-5)
    # It holds nine pixels.
    pixels = np.asarray(beam_weights(STATIC, PARAMS) > 0).sum(axis=1)
    assert pixels[CENTRE] == 9
    np.testing.assert_allclose(by_area, unseen * pixels / pixels.max(), rtol=1e-5)
    np.testing.assert_allclose(by_root, unseen * np.sqrt(pixels / pixels.max()), rtol=1e-5)
    neighbours = [CENTRE + a * L + e for a in (-1, 0, 1) for e in (-1, 0, 1) if (a, e) != (0, 0)]
    np.testing.assert_allclose(around[CENTRE], unseen[neighbours].mean(), rtol=1e-5)
    np.testing.assert_allclose(azimuth.reshape(L, L)[:, 0], [-1, -0.5, 0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(elevation.reshape(L, L)[0], [-1, -0.5, 0, 0.5, 1], atol=1e-6)


def test_neighbours_outside_the_field_count_nothing():
    np.testing.assert_allclose(mean_of_neighbours(jnp.ones((3, 3)))[:2, 1], [5 / 8, 1])
    np.testing.assert_allclose(mean_of_neighbours(jnp.arange(9.0).reshape(3, 3))[0], [8 / 8, 14 / 8, 10 / 8])


def test_the_context_is_of_the_whole_picture(features):
    context = features(observe(track(0.04), track(0.16), track(0.36))).context
    root = (0.2 + 0.4 + 0.6) / 3
    np.testing.assert_allclose(context, [3 / 4, 40 / 81, 0, 0.56 / 3, root, 0.36, 1], rtol=1e-5)
    # 40/81 is the mean of 0..80 over 81. Without a track the norms are 0, not NaN.
    np.testing.assert_allclose(features(observe(seen=False)).context, [0, 1, 1, 0, 0, 0, 0], rtol=1e-5)


@pytest.mark.parametrize(
    ("tracks", "of_velocity", "complete"),
    [
        (2, [0.1, 0.1, 0.1, 0.1], 0),
        (3, [0.1, 0.2, 0.48, 0.1], 1),
        (3, [0.1, 0.2, 0.49, 0.1], 0),  # 0.9 x 3 x 30^2 / 5000 = 0.486: a track of one detection
        (4, [0.1, 0.2, 0.49, 0.1], 1),
        (3, [0.1, 0.2, jnp.nan, 0.1], 0),
    ],
)
def test_the_context_tells_whether_all_truths_have_confirmed_tracks(features, tracks, of_velocity, complete):
    variances = jnp.stack([jnp.full(T, 0.1), jnp.asarray(of_velocity)], axis=-1)
    observation = {**observe(*[track(0.2)] * tracks), "variances": variances}
    assert features(observation).context[-1] == complete


def test_empty_rows_may_hold_anything(features):
    clean = features(observe(track(0.2)))
    for padding in (np.nan, np.inf, 0.5):
        jax.tree.map(np.testing.assert_array_equal, features(observe(track(0.2), padding=padding)), clean)


@pytest.fixture(scope="module")
def drawn(draw_variables):
    """A network with weights, and random inputs of three observations; slot 3 is empty."""
    rng = np.random.default_rng(0)
    mask = np.broadcast_to(np.arange(T) < 3, (3, T))
    inputs = BeamInputs(
        search=jnp.asarray(rng.uniform(0, 1, (3, 9, L * L)), dtype=float),
        inside=jnp.asarray((rng.uniform(0, 1, (3, T, L * L)) < 0.3) & mask[..., None]),
        tracks=jnp.asarray(rng.uniform(0, 1, (3, T, 9)) * mask[..., None], dtype=float),
        mask=jnp.asarray(mask),
        context=jnp.asarray(rng.uniform(0, 1, (3, 7)), dtype=float),
    )
    network = BeamNetwork(width=8)
    return jax.jit(network.apply), draw_variables(network, inputs), inputs


def test_the_order_of_the_tracks_changes_nothing(drawn):
    apply, weights, inputs = drawn
    logits, value = apply(weights, inputs)
    assert logits.shape == (3, L * L)
    assert value.shape == (3,)
    assert np.ptp(logits, axis=1).min() > 1e-3
    order = np.array([3, 1, 0, 2])
    slots = {name: getattr(inputs, name)[:, order] for name in ("inside", "tracks", "mask")}
    permuted_logits, permuted_value = apply(weights, inputs.replace(**slots))
    np.testing.assert_allclose(permuted_logits, logits, atol=1e-4)
    np.testing.assert_allclose(permuted_value, value, atol=1e-5)


def test_a_look_is_worth_what_its_own_beam_holds(drawn):
    apply, weights, inputs = drawn
    logits, value = apply(weights, inputs)
    # A track that enters one beam more changes the worth of that look only; so does its scan value.
    free = int(np.flatnonzero(~np.asarray(inputs.inside[:, 0]).any(axis=0))[0])
    entered, entered_value = apply(weights, inputs.replace(inside=inputs.inside.at[:, 0, free].set(True)))
    staler, staler_value = apply(weights, inputs.replace(search=inputs.search.at[:, 0, free].add(1.0)))
    for changed, changed_value in ((entered, entered_value), (staler, staler_value)):
        moved = np.abs(changed - logits) > 1e-4
        assert moved[:, free].all()
        assert not np.delete(moved, free, axis=1).any()
        np.testing.assert_array_equal(changed_value, value)
    # Observations of a batch do not mix.
    single, _ = apply(weights, jax.tree.map(lambda leaf: leaf[1], inputs))
    np.testing.assert_allclose(single, logits[1], atol=1e-4)


def test_what_empty_slots_hold_counts_nothing(drawn):
    apply, weights, inputs = drawn
    logits, value = apply(weights, inputs)
    filled = inputs.replace(tracks=inputs.tracks.at[:, 3].set(5.0), inside=inputs.inside.at[:, 3].set(True))
    other_logits, other_value = apply(weights, filled)
    np.testing.assert_array_equal(other_logits, logits)
    np.testing.assert_array_equal(other_value, value)
