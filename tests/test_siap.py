"""Which track follows which truth, and SIAP, by hand.

Truth A stands at x = 0 and truth B at x = 1000 m; a track lies `OFFSET` from one of them or far
from both. Tracks are written as words, one letter per step: A or B near that truth, . near
none, blank for no track, and a new track in the slot after a blank or where the case is lower
(a, b: the first step of a track that directly replaces another).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, Tracks, Truths
from jaxtrack.metrics import begins
from jaxtrack.siap import siap
from jaxtrack.track_to_truth import associate_tracks_to_truths
from jaxtrack.types import NO_TRUTH

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS, SLOTS = 14, 3
OFFSET = 30.0
PLACES = {"A": 0.0, "B": 1000.0, ".": 500.0, " ": np.nan}
PARAMS = Params(siap_threshold=200.0, siap_confirm_steps=3, siap_end_steps=2)
TIMES = 2.0 * np.arange(STEPS, dtype=np.float32)
siap_of = jax.jit(siap)


@jax.jit
def stretches_of(truths, tracks, params):
    return associate_tracks_to_truths(truths, tracks, begins(tracks), params)


def truths_of(lives_of_a=(0, STEPS), lives_of_b=(0, STEPS)):
    """Truths A and B with the steps on which they live, first to one past the last."""
    state = np.zeros((STEPS, 2, 6), np.float32)
    state[:, 1, 0] = PLACES["B"]
    steps = np.arange(STEPS)
    alive = np.stack([(first <= steps) & (steps < last) for first, last in (lives_of_a, lives_of_b)], axis=1)
    return Truths(jnp.asarray(state), jnp.asarray(alive))


def tracks_of(*words):
    """Tracks with one slot per word."""
    words = [word.ljust(STEPS) for word in (*words, *[""] * (SLOTS - len(words)))]
    mean = np.zeros((STEPS, SLOTS, 6), np.float32)
    births = np.full((STEPS, SLOTS), -1)
    for slot, word in enumerate(words):
        for step, letter in enumerate(word):
            mean[step, slot, 0] = PLACES[letter.upper()]
            mean[step, slot, 1:3] = 4.0, OFFSET  # vx, y
            if letter != " ":
                new = step == 0 or word[step - 1] == " " or letter.islower()
                births[step, slot] = step if new else births[step - 1, slot]
    return jax.vmap(lambda _: Tracks.empty(SLOTS))(TIMES).replace(
        mean=jnp.asarray(mean), active=jnp.asarray(births >= 0), birth_step=jnp.asarray(births)
    )


def stretches(word, params=PARAMS, truths=None):
    """(truth, first step, last step) of all associations of one slot, in their order."""
    found = stretches_of(truths or truths_of(), tracks_of(word), params)
    rows = zip(*(np.asarray(leaf)[:, 0] for leaf in (found.truth, found.start, found.end)), strict=True)
    return [("AB"[truth], int(start), int(end)) for truth, start, end in rows if truth != NO_TRUTH]


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("AAA", [("A", 0, 2)]),
        ("AA.AA", []),
        ("..AAAA.", [("A", 2, 5)]),  # dated back to the first of the three
        ("AAA.AA", [("A", 0, 5)]),  # one miss does not matter
        ("AAA.", [("A", 0, 2)]),  # but does not count at the end
        ("AAA..AAA", [("A", 0, 2), ("A", 5, 7)]),
        ("AAABBB", [("A", 0, 2), ("B", 3, 5)]),
        ("ABABAB", []),
        ("AAABAABA", [("A", 0, 7)]),
        # B's hits need not be in a row while the track is A's: at once B's, dated back into A's time.
        ("AAABABABB", [("A", 0, 6), ("B", 3, 8)]),
        ("AAAB.BABB", [("A", 0, 2)]),
        # The two misses that ended A's time are not forgotten until the next hit after confirmation.
        ("AAA..AAA.AAA", [("A", 0, 2), ("A", 5, 7), ("A", 9, 11)]),
        ("AAA..AAAA.AAA", [("A", 0, 2), ("A", 5, 12)]),
        # Another track in the slot starts from nothing.
        ("AAaaA", []),
        ("AAAaAA.", [("A", 0, 2), ("A", 3, 5)]),
        ("AA AAA", [("A", 3, 5)]),
        ("AAA  b.BBB", [("A", 0, 2), ("B", 7, 9)]),
        ("AAA.bBB", [("A", 0, 2), ("B", 4, 6)]),
    ],
)
def test_a_track_belongs_to_the_truth_that_it_stays_near(word, expected):
    assert stretches(word) == expected


def test_numbers_of_steps_are_free():
    assert stretches("AA.A.AA", PARAMS.replace(siap_confirm_steps=2)) == [("A", 0, 6)]
    assert stretches("AA.AA", PARAMS.replace(siap_confirm_steps=2, siap_end_steps=1)) == [
        ("A", 0, 1),
        ("A", 3, 4),
    ]
    assert stretches("AAA..A...A", PARAMS.replace(siap_end_steps=3)) == [("A", 0, 5)]
    assert stretches("AAAA", PARAMS.replace(siap_confirm_steps=5)) == []


def test_the_threshold_is_strict():
    assert stretches("AAA", PARAMS.replace(siap_threshold=OFFSET)) == []
    assert stretches("AAA", PARAMS.replace(siap_threshold=OFFSET * 1.001)) == [("A", 0, 2)]


def test_only_living_truths_are_near():
    assert stretches("AAAAAA", truths=truths_of(lives_of_a=(1, 5))) == [("A", 1, 4)]


def totals(*words, truths=None):
    return siap_of(truths or truths_of(), tracks_of(*words), TIMES, PARAMS)


def test_one_good_track_and_one_that_follows_nobody():
    result = totals("AAAAA", " ..")
    np.testing.assert_allclose(result.completeness, 5 / (2 * STEPS), rtol=1e-6)
    np.testing.assert_allclose(result.ambiguity, 1.0)
    np.testing.assert_allclose(result.spuriousness, 2 / 7, rtol=1e-6)
    np.testing.assert_allclose(result.position_accuracy, OFFSET, rtol=1e-6)
    np.testing.assert_allclose(result.velocity_accuracy, 4.0, rtol=1e-6)
    np.testing.assert_allclose(result.track_change_rate, 0.0)
    # 8 s of A's 26 s; B's 26 s count in full.
    np.testing.assert_allclose(result.longest_segment, 8 / 52, rtol=1e-6)
    np.testing.assert_allclose(result.at_times.completeness, [0.5] * 5 + [0] * 9)
    np.testing.assert_allclose(result.at_times.ambiguity, 1.0)
    np.testing.assert_allclose(result.at_times.spuriousness[:4], [0, 0.5, 0.5, 0])
    np.testing.assert_allclose(result.at_times.position_accuracy, [OFFSET] * 5 + [0] * 9, rtol=1e-6)
    np.testing.assert_allclose(result.at_times.velocity_accuracy, [4] * 5 + [0] * 9, rtol=1e-6)


def test_a_missed_step_counts_with_its_error():
    result = totals("AA.AA.A")
    np.testing.assert_allclose(result.completeness, 0.0)
    result = totals("AAA.A")
    far = np.hypot(500.0, OFFSET)
    np.testing.assert_allclose(result.position_accuracy, (4 * OFFSET + far) / 5, rtol=1e-6)
    np.testing.assert_allclose(result.at_times.position_accuracy[3], far, rtol=1e-6)


def test_two_tracks_of_one_truth():
    result = totals("AAAAA", "   AAAAAAA")
    np.testing.assert_allclose(result.completeness, 10 / (2 * STEPS), rtol=1e-6)
    np.testing.assert_allclose(result.ambiguity, 12 / 10, rtol=1e-6)
    # One change in the 18 s from step 0 to 9; the second track has 12 s.
    np.testing.assert_allclose(result.track_change_rate, 1 / 18, rtol=1e-6)
    np.testing.assert_allclose(result.longest_segment, 12 / 52, rtol=1e-6)


def test_a_track_passing_from_truth_to_truth_may_count_for_both():
    result = totals("AAABABABB")
    np.testing.assert_allclose(result.at_times.completeness, [0.5] * 3 + [1] * 4 + [0.5] * 2 + [0] * 5)
    np.testing.assert_allclose(result.at_times.ambiguity[3:7], 0.5)  # one track, two truths
    np.testing.assert_allclose(result.track_change_rate, 0.0)
    np.testing.assert_allclose(result.longest_segment, (12 + 10) / 52, rtol=1e-6)


def test_stretches_of_one_track_add_up_and_those_of_two_do_not():
    np.testing.assert_allclose(totals("AAA..AAAA").longest_segment, (4 + 6) / 52, rtol=1e-6)
    np.testing.assert_allclose(totals("AAAaAAA").longest_segment, 6 / 52, rtol=1e-6)
    np.testing.assert_allclose(totals("AAA..AAAA").track_change_rate, 1 / 10, rtol=1e-6)
    # Between one track's last step and the next one's first the truth is not followed.
    np.testing.assert_allclose(totals("AAAaAAA").track_change_rate, 1 / 10, rtol=1e-6)


def test_the_walk_breaks_off_on_the_last_step_of_a_stretch():
    # At step 5 only the second track is left, and it ends there: the third is never counted.
    result = totals("AAAAA  AAA", "  AAAA")
    np.testing.assert_allclose(result.track_change_rate, 1 / (2 * 5 + 2 * 2), rtol=1e-6)
    # One step more of the second track, and it is.
    result = totals("AAAAA  AAA", "  AAAAA")
    np.testing.assert_allclose(result.track_change_rate, 2 / (2 * 6 + 2 * 2), rtol=1e-6)


def test_the_walk_takes_the_track_that_is_seen_last_of_all():
    # The first track comes back later, so that it is taken although its stretch is the shorter.
    result = totals("AAA...AAAA", "AAAAAAAAA")
    np.testing.assert_allclose(result.track_change_rate, 2 / 18, rtol=1e-6)


def test_associations_that_end_together_are_taken_by_their_present_stretch():
    result = totals("AAA..AAAA", "AAAAAAAAA")
    np.testing.assert_allclose(result.track_change_rate, 0.0)


def test_a_truth_lives_from_its_first_to_its_last_step():
    result = totals("AAAAAA", truths=truths_of(lives_of_a=(1, 5), lives_of_b=(3, 4)))
    np.testing.assert_allclose(result.completeness, 4 / 5, rtol=1e-6)
    np.testing.assert_allclose(result.longest_segment, 6 / 6, rtol=1e-6)
    np.testing.assert_allclose(result.spuriousness, 2 / 6, rtol=1e-6)


@pytest.mark.parametrize("words", [(), ("AAAAA", ".....")])
def test_nothing_to_judge_gives_the_neutral_values(words):
    nobody = truths_of((0, 0), (0, 0))
    result = totals(*words, truths=nobody if words else None)
    leaves = [result.completeness, result.position_accuracy, result.velocity_accuracy]
    leaves += [result.track_change_rate, result.longest_segment]
    np.testing.assert_allclose(leaves, 0.0)
    np.testing.assert_allclose(result.ambiguity, 1.0)
    np.testing.assert_allclose(result.spuriousness, 1.0 if words else 0.0)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(result))


def test_a_record_of_one_step_is_allowed():
    truths, tracks = jax.tree.map(lambda leaf: leaf[:1], (truths_of(), tracks_of("A")))
    result = siap_of(truths, tracks, TIMES[:1], PARAMS)
    np.testing.assert_allclose([result.completeness, result.spuriousness], [0.0, 1.0])


def test_records_together_are_judged_as_alone_however_large(monkeypatch):
    truths, tracks = truths_of(lives_of_b=(3, 12)), tracks_of("AAABABABB", "  AAAA.AAAA")
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[:, ::-1]]), (truths, tracks))
    for largest in (1000, 5):
        monkeypatch.setattr("jaxtrack.siap.LARGEST_IN_ONE_KERNEL", largest)
        together = jax.jit(jax.vmap(siap, in_axes=(0, 0, None, None)))(*both, TIMES, PARAMS)
        for i in range(2):
            alone = siap_of(*jax.tree.map(lambda leaf, i=i: leaf[i], both), TIMES, PARAMS)
            jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-6), together, alone)


def test_a_step_without_the_truth_has_no_error():
    there = truths_of()
    gone = Truths(there.state.at[3, 0].set(1e6), there.alive.at[3, 0].set(False))
    result = totals("AAAAAA", truths=gone)
    np.testing.assert_allclose(result.at_times.position_accuracy[:6], [OFFSET] * 3 + [0] + [OFFSET] * 2)
