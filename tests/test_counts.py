"""Counts of detections and of the time without one."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack.counts import LONGEST, Counts, to_microseconds


def test_a_life_by_hand():
    counts = Counts.zero(2).initiated(jnp.array([True, False]))
    np.testing.assert_array_equal(counts.hits, [1, 0])
    counts = counts.predicted(0.1).updated(jnp.array([False, False]))
    counts = counts.predicted(0.2)
    np.testing.assert_array_equal(counts.missed_steps, [2, 2])
    np.testing.assert_array_equal(counts.missed_time, [300_000, 300_000])
    counts = counts.updated(jnp.array([True, False]))
    np.testing.assert_array_equal(counts.hits, [2, 0])
    np.testing.assert_array_equal(counts.missed_steps, [0, 2])
    np.testing.assert_array_equal(counts.missed_time, [0, 300_000])
    counts = counts.initiated(jnp.array([False, True]))
    np.testing.assert_array_equal(counts.hits, [2, 1])
    np.testing.assert_array_equal(counts.missed_steps, [0, 0])
    np.testing.assert_array_equal(counts.missed_time, [0, 0])


def test_a_step_of_no_duration_is_none():
    counts = Counts.zero(1).predicted(0.0)
    assert counts.missed_steps[0] == counts.missed_time[0] == 0


def test_time_adds_up_exactly_in_single_precision():
    counts = Counts.zero(1)
    for _ in range(300):
        counts = counts.predicted(jnp.float32(0.1))
    assert counts.missed_time[0] == to_microseconds(30.0) == 30_000_000


@pytest.mark.parametrize("step", [600.0, 5000.0, 1e6])
def test_long_times_do_not_overflow(step):
    counts = Counts.zero(1)
    for _ in range(4):
        counts = counts.predicted(step)
    assert counts.missed_time[0] == LONGEST - 1 > to_microseconds(1000.0)
    assert counts.missed_time.dtype == Counts.zero(1).missed_time.dtype


def test_halves_of_microseconds_go_to_the_even_number():
    assert [int(to_microseconds(x * 1e-6)) for x in (0.5, 1.5, 2.5)] == [0, 2, 2]
