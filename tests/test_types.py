"""The records: empty track lists, wrapped detections, the state's order."""

import jax.numpy as jnp
import numpy as np

from jaxtrack.types import (
    NEVER,
    NO_DETECTION,
    NO_TRUTH,
    Detections,
    Tracks,
    position,
    velocity,
    where_rows,
)


def test_an_empty_track_list_holds_no_track():
    tracks = Tracks.empty(3)
    assert tracks.mean.shape == (3, 6)
    assert tracks.covariance.shape == (3, 6, 6)
    np.testing.assert_array_equal(tracks.active, [False] * 3)
    np.testing.assert_array_equal(tracks.updated_by, [NO_DETECTION] * 3)
    np.testing.assert_array_equal(tracks.birth_step, [NEVER] * 3)
    np.testing.assert_array_equal(tracks.birth_detection, [NO_DETECTION] * 3)
    np.testing.assert_array_equal(tracks.age, [0] * 3)


def test_nothing_can_be_mistaken_for_an_index():
    assert max(NEVER, NO_DETECTION, NO_TRUTH) < 0


def test_recorded_detections_all_count_unless_masked():
    value = [[0.1, 0.2, 3000], [0.3, 0.4, 5000]]
    everything = Detections.from_values(value)
    np.testing.assert_allclose(everything.value, value, rtol=1e-6)
    np.testing.assert_array_equal(everything.active, [True, True])
    np.testing.assert_array_equal(everything.truth, [NO_TRUTH] * 2)
    assert jnp.issubdtype(everything.value.dtype, jnp.floating)
    one = Detections.from_values(value, [False, True])
    np.testing.assert_array_equal(one.active, [False, True])


def test_states_interleave_position_and_velocity():
    state = jnp.array([[1.0, 10.0, 2.0, 20.0, 3.0, 30.0]])
    np.testing.assert_array_equal(position(state), [[1, 2, 3]])
    np.testing.assert_array_equal(velocity(state), [[10, 20, 30]])


def test_where_rows_chooses_whole_rows_of_any_rank():
    mask = jnp.array([True, False])
    for shape in [(2,), (2, 3), (2, 3, 3)]:
        chosen = where_rows(mask, jnp.ones(shape), jnp.zeros(shape))
        np.testing.assert_array_equal(chosen[0], np.ones(shape[1:]))
        np.testing.assert_array_equal(chosen[1], np.zeros(shape[1:]))
