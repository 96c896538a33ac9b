"""Reward terms by hand arithmetic."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import NO_DETECTION, Params, StaticParams, Tracks, Truths
from jaxtrack.params import REWARDS
from jaxtrack.reward import (
    TRACK_TERMS,
    accuracy,
    covariance_growth,
    covariance_reduction,
    information,
    reward_terms,
    shortfall,
)

STATIC = StaticParams(num_truths=4)
PARAMS = Params(deletion_threshold=1000.0)
NONE = NO_DETECTION
NOBODY = Truths(state=jnp.zeros((4, 6)), alive=jnp.zeros(4, dtype=bool))


def track_list(norms, updated_by, ages=None, active=None):
    """Tracks whose covariance has one entry, so that norm and trace are that number."""
    count = len(norms)
    return Tracks.empty(count).replace(
        covariance=jnp.zeros((count, 6, 6)).at[:, 0, 0].set(jnp.asarray(norms, float)),
        updated_by=jnp.array(updated_by),
        age=jnp.array([5] * count if ages is None else ages),
        active=jnp.array([True] * count if active is None else active),
    )


def reduction(before, after):
    return float(covariance_reduction(before, after, NOBODY, STATIC, PARAMS))


def test_only_tracks_detected_now_or_one_step_ago_count():
    before = track_list([500, 400, 300, 200], [NONE, 0, 1, NONE])
    after = track_list([100, 450, 50, 260], [0, NONE, 1, NONE])
    # Now: 500 - 100. One step ago: 400 - 450. Both: 300 - 50. Neither: nothing.
    np.testing.assert_allclose(reduction(before, after), (400 - 50 + 250) / 1000, rtol=1e-6)


def test_births_and_deaths_are_worth_nothing():
    # Slot 0 dies, though detected before; slot 1 is born in a slot never used.
    before = track_list([900, 0], [0, NONE], active=[True, False])
    after = track_list([950, 80], [NONE, 0], ages=[6, 0], active=[False, True])
    assert reduction(before, after) == 0.0


def test_a_track_born_in_the_slot_of_one_just_deleted_is_worth_nothing():
    before = track_list([900], [0], ages=[7])
    after = track_list([80], [1], ages=[0])
    assert reduction(before, after) == 0.0
    # On the next step it is an ordinary track.
    assert reduction(after, track_list([30], [NONE], ages=[1])) == pytest.approx(0.05)


def test_the_norm_is_that_of_the_whole_matrix():
    full = track_list([0], [0]).replace(covariance=jnp.full((1, 6, 6), 50.0))
    assert reduction(full, track_list([100], [0])) == pytest.approx((300 - 100) / 1000)


def test_as_printed_is_the_opposite_sign():
    before, after = track_list([500], [NONE]), track_list([100], [0])
    assert float(covariance_growth(before, after, NOBODY, STATIC, PARAMS)) == pytest.approx(-0.4)


def test_information_pays_for_every_certain_live_track():
    before = track_list([9, 9, 9, 9], [0, 0, 0, 0])
    after = track_list([0, 250, 1500, 100], [NONE] * 4, active=[True, True, True, False])
    # 1 + 0.75 + 0 for the lost one, over 4 truths; the empty slot counts nothing.
    assert float(information(before, after, NOBODY, STATIC, PARAMS)) == pytest.approx(1.75 / 4)


def test_information_uses_the_trace():
    after = track_list([0], [0]).replace(covariance=jnp.full((1, 6, 6), 50.0))
    assert float(information(after, after, NOBODY, STATIC, PARAMS)) == pytest.approx((1 - 0.3) / 4)


def test_shortfall_charges_live_tracks_by_their_trace_and_deleted_ones_once():
    before = track_list([9, 9, 9, 9], [0, 0, 0, 0], active=[True, True, False, True])
    after = track_list([100, 1500, 250, 300], [NONE] * 4, active=[True, True, True, False])
    # 0.1, at most 1, 0.25 for a new track; the last one was deleted.
    assert float(shortfall(before, after, NOBODY, STATIC, PARAMS)) == pytest.approx(-(1.35 + 200) / 4)
    # Deleted, and its slot taken at once.
    replaced = after.replace(active=jnp.ones(4, bool), birth_step=after.birth_step.at[3].set(7))
    assert float(shortfall(before, replaced, NOBODY, STATIC, PARAMS)) == pytest.approx(-(1.65 + 200) / 4)
    # Nothing lost, nothing found: the empty slot costs nothing.
    assert float(shortfall(before, before, NOBODY, STATIC, PARAMS)) == pytest.approx(-0.027 / 4)


@pytest.mark.parametrize(
    ("name", "track"), [("paper", 0.4), ("as_printed", -0.4), ("information", 0.225), ("shortfall", -0.025)]
)
def test_rewards_by_name_are_weighted_and_searching_costs_the_mean_scan_value(name, track):
    static = StaticParams(num_truths=4, reward=name)
    params = PARAMS.replace(track_weight=3.0, search_weight=0.5)
    scan_map = jnp.array([[0.0, 1.0], [0.5, 0.1]])
    before, after = track_list([500], [NONE]), track_list([100], [0])
    track_term, search_term = reward_terms(before, after, NOBODY, scan_map, static, params)
    assert float(track_term) == pytest.approx(3 * track)
    assert float(search_term) == pytest.approx(-0.5 * 0.4)
    sharp = dataclasses.replace(static, search_sharpness=2)
    terms = reward_terms(before, after, NOBODY, scan_map, sharp, params)
    assert float(terms[0]) == float(track_term)
    assert float(terms[1]) == pytest.approx(-0.5 * (0 + 1 + 0.25 + 0.01) / 4)


def test_search_costs_nothing_while_all_truths_have_confirmed_tracks():
    """Four truths; confirmed is below 0.9 of a new track's variance of velocity, 3 x 30^2 = 2700 (m/s)^2."""
    static = StaticParams(num_truths=4, search_until_complete=True)
    scan_map = jnp.full((2, 2), 0.5)

    def search(of_velocity, active=(True,) * 4):
        tracks = track_list([1.0] * 4, [NONE] * 4, active=list(active))
        spread = jnp.zeros((4, 6, 6)).at[:, 1, 1].set(jnp.asarray(of_velocity)).at[:, 0, 0].set(5000.0)
        tracks = tracks.replace(covariance=spread)
        _, term = reward_terms(tracks, tracks, NOBODY, scan_map, static, PARAMS.replace(search_weight=2.0))
        return float(term)

    known, new = 2429.0, 2431.0
    assert search([known] * 4) == 0
    assert search([known, known, new, known]) == -1, "a track of one detection may be false"
    assert search([known] * 4, [True, True, False, True]) == -1
    static = StaticParams(num_truths=5, search_until_complete=True)
    assert search([known] * 4) == -1


def test_gospa_is_worth_one_for_perfect_tracks_and_nothing_without_any():
    params = PARAMS.replace(gospa_cutoff=100.0)
    state = jnp.zeros((4, 6)).at[:, 0].set(jnp.array([1000.0, 3000.0, 5000.0, 7000.0]))
    truths = Truths(state=state, alive=jnp.array([True, True, False, False]))

    nothing = track_list([1.0] * 4, [NONE] * 4, active=[False] * 4)
    worth_of = jax.jit(accuracy, static_argnums=3)

    def worth(means, active, truths=truths, params=params):
        after = nothing.replace(mean=means, active=jnp.array(active))
        return float(worth_of(nothing, after, truths, STATIC, params))

    assert worth(state, [True, True, False, False]) == pytest.approx(1.0)
    assert worth(state, [False] * 4) == pytest.approx(0.0)
    # One truth missed costs c^2 / 2 of 2 c^2 / 2 in the square.
    assert worth(state, [True, False, False, False]) == pytest.approx(1 - np.sqrt(0.5))
    # Four tracks, two of them false, none on a truth: sqrt(6/2) against sqrt(2/2).
    assert worth(state + 500, [True] * 4) == pytest.approx(1 - np.sqrt(3.0))
    # Of the first order it is the share of truths missed; without truths or tracks nothing is wrong.
    first_order = params.replace(gospa_order=1.0)
    all_alive = truths.replace(alive=jnp.ones(4, dtype=bool))
    assert worth(state, [True] + [False] * 3, all_alive, first_order) == pytest.approx(0.25)
    assert worth(state, [False] * 4, truths.replace(alive=jnp.zeros(4, dtype=bool))) == 1.0


def test_every_name_of_a_reward_has_its_function():
    assert set(TRACK_TERMS) == set(REWARDS)


@pytest.mark.parametrize("same_birth", [False, True])
@pytest.mark.parametrize("was_active", [False, True])
def test_a_track_that_enters_late_is_new_to_its_slot(same_birth, was_active):
    """Some steps old, it takes the place of a track of the same look that was deleted just then."""
    static = dataclasses.replace(STATIC, initiator="multi_measurement")
    before = track_list([900], [0], active=[was_active]).replace(birth_step=jnp.array([3]))
    after = track_list([80], [1]).replace(birth_step=jnp.array([3]))
    before, after = (
        each.replace(birth_detection=jnp.array([detection]))
        for each, detection in ((before, 0), (after, 0 if same_birth else 1))
    )
    stayed = same_birth and was_active
    fall = covariance_reduction(before, after, NOBODY, static, PARAMS)
    assert float(fall) == pytest.approx(0.82 if stayed else 0.0)
    deleted = was_active and not stayed
    cost = shortfall(before, after, NOBODY, static, PARAMS)
    assert float(cost) == pytest.approx(-(0.08 + 200.0 * deleted) / 4)
