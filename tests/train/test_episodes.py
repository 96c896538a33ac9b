"""Playing policies on the same scenarios, and what is measured of an episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from jaxtrack.policies import POLICIES
from jaxtrack.sensor import look_number
from train import episode_metrics, episodes
from train.episode_metrics import CURVES, METRICS, NEES_BAND, mean_wait, nees
from train.episodes import Competitor, compare, rule
from train.results import summarise

pytestmark = pytest.mark.usefixtures("quick_compilation")

LOOKS = 4
STATIC = StaticParams(
    num_truths=3,
    max_tracks=4,
    max_detections=4,
    max_clutter=1,
    map_size=8,
    num_looks=LOOKS,
    reward="information",
)
LENGTH = 40
EPISODES = 20
SEED = 0
# Tracks are lost and found again, some are false, and for some steps there is none.
PARAMS = Params(
    max_steps_in_episode=LENGTH,
    time_step=0.05,
    beam_azimuth=0.7,
    beam_elevation=0.7,
    clutter_rate=0.05,
    deletion_threshold=4000.0,
)
ENV = SearchTrack(STATIC)
# Memory for a little more, of which three equal chunks are made.
SEVEN_EPISODES = 9 * episodes.BYTES_PER_PAIR * LENGTH * 12


def fixed(index):
    """A policy that always takes the look of that number: its weight."""

    def build(static, params):
        return lambda key, state: jnp.stack([index // static.num_looks, index % static.num_looks])

    return build


def swapped(static, params):
    """A planted error: the index rule with azimuth and elevation exchanged."""
    right = POLICIES["index"](static, params)
    return lambda key, state: right(key, state)[::-1]


COMPETITORS = {
    "trained": Competitor(fixed, [jnp.asarray(7), jnp.asarray(9)], (0, 3)),
    "index": rule(POLICIES["index"]),
    "static": rule(POLICIES["static"]),
    "again": rule(POLICIES["index"]),
    "swapped": rule(swapped),
}


@pytest.fixture(scope="module")
def compared():
    """A comparison in chunks of seven episodes, what progress was told, and what was compiled."""
    told, kept = [], []
    compile_program = episodes.compile_program

    def compile_and_keep(*arguments):
        kept.append(compile_program(*arguments))
        return kept[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episodes, "compile_program", compile_and_keep)
        patch.setattr(episodes, "MEMORY", SEVEN_EPISODES)
        return compare(COMPETITORS, ENV, PARAMS, EPISODES, SEED, told.append), told, kept[0]


@pytest.fixture(scope="module")
def stepped():
    """Some episodes of all chunks of the index rule, step by step through the environment."""
    policy = POLICIES["index"](STATIC, PARAMS)

    @jax.jit
    def step(key_policy, state, key):
        action = policy(key_policy, state)
        return action, ENV.advance(state, action, ENV.sample_noise(key), PARAMS)[0]

    played = {}
    keys = jax.random.split(jax.random.key(SEED), EPISODES)
    for episode in (0, 8, 13, 19):
        key = keys[episode]
        key_reset, key_noise, key_policy = jax.random.split(key, 3)
        _, state = ENV.reset_env(key_reset, PARAMS)
        rows = []
        for key_step in jax.random.split(key_noise, LENGTH):
            action, state = step(key_policy, state, key_step)
            rows.append(jax.device_get((state.truths, state.tracks, state.scan_map, action)))
        played[episode] = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    return played


def test_the_same_policy_meets_the_same_scenarios(compared):
    comparison, told, _ = compared
    played = comparison.played
    assert list(played) == list(COMPETITORS)
    assert told == [7, 7, 6] * 6  # three chunks for each of six sets of weights
    for metric in METRICS:
        assert played["index"].values[metric].shape == (1, EPISODES)
        np.testing.assert_array_equal(played["index"].values[metric], played["again"].values[metric])
    assert (played["index"].values["completeness"] > played["static"].values["completeness"]).any()
    assert len(set(played["index"].values["gospa"][0])) == EPISODES
    assert comparison.compile_seconds > 0
    assert comparison.play_seconds > 0


def test_every_training_seed_plays_with_its_own_weights(compared):
    trained = compared[0].played["trained"]
    assert trained.seeds == (0, 3)
    assert trained.values["gospa"].shape == (2, EPISODES)
    expected = np.zeros((LOOKS, LOOKS))
    expected[1, 3] = expected[2, 1] = 0.5  # looks 7 and 9
    np.testing.assert_allclose(trained.looks, expected)


def test_metrics_are_those_of_the_episode_played_step_by_step(compared, stepped):
    found = compared[0].played["index"].values
    for episode, (truths, tracks, scan_map, _) in stepped.items():
        for metric, value in by_hand(truths, tracks, scan_map).items():
            np.testing.assert_allclose(
                found[metric][0, episode], value, rtol=2e-4, atol=1e-6, err_msg=f"{metric} of {episode}"
            )


def by_hand(truths, tracks, scan_map):
    """Metrics of a record, from numpy as far as it goes."""
    distances = np.linalg.norm(truths.state[:, :, None, 0::2] - tracks.mean[:, None, :, 0::2], axis=-1)
    distances = np.where(truths.alive[:, :, None] & tracks.active[:, None], distances, np.inf)
    tracked = (distances < PARAMS.gospa_cutoff).any(axis=2)
    first = [np.flatnonzero(column)[0] + 1 if column.any() else LENGTH for column in tracked.T]
    births = {
        (int(step), int(row))
        for step, row in zip(
            tracks.birth_step[tracks.active], tracks.birth_detection[tracks.active], strict=True
        )
    }
    norms = np.where(tracks.active, np.linalg.norm(tracks.covariance, axis=(2, 3)), 0.0).sum(axis=1)
    number = tracks.active.sum(axis=1)
    trace = np.trace(tracks.covariance, axis1=2, axis2=3)
    worth = np.where(tracks.active, np.maximum(0, 1 - trace / PARAMS.deletion_threshold), 0.0)
    gospa = np.array([gospa_by_hand(*step) for step in zip(distances, number, strict=True)])
    errors = consistency(truths, tracks, distances)
    return {
        "gospa": np.sqrt(gospa.sum(axis=1)).mean(),
        "gospa_localisation": gospa[:, 0].mean(),
        "gospa_missed": gospa[:, 1].mean(),
        "gospa_false": gospa[:, 2].mean(),
        "completeness": tracked.mean(),
        "track_to_target_ratio": len(births) / 3,
        "mean_track_to_target_ratio": number.mean() / 3,
        "covariance_norm_sum": norms.mean(),
        "covariance_norm_mean": (norms / np.maximum(number, 1)).mean(),
        "covariance_norm_when_tracking": (norms[number > 0] / number[number > 0]).mean(),
        "time_to_first_track": PARAMS.time_step * np.mean(first),
        "truths_ever_tracked": tracked.any(axis=0).mean(),
        "track_breaks": len(births) - tracked.any(axis=0).sum(),
        "nees": np.mean(errors) / 6,
        "nees_inside": np.mean([NEES_BAND[0] <= error <= NEES_BAND[1] for error in errors]),
        "mean_scan_value": scan_map.mean(),
        "episode_return": worth.sum() / 3 - PARAMS.search_weight * scan_map.mean() * LENGTH,
    }


def gospa_by_hand(distances, number):
    """Localisation, missed and false (m^2) of a step with distances `[N, T]`."""
    cutoff = PARAMS.gospa_cutoff
    rows, columns = linear_sum_assignment(np.minimum(distances, cutoff) ** 2)
    assigned = distances[rows, columns]
    close = assigned[assigned < cutoff]
    return (close**2).sum(), (3 - close.size) * cutoff**2 / 2, (number - close.size) * cutoff**2 / 2


def consistency(truths, tracks, distances):
    """NEES of every track with a truth near it."""
    errors = []
    for step, slot in np.argwhere((distances < PARAMS.gospa_cutoff).any(axis=1)):
        error = truths.state[step, distances[step, :, slot].argmin()] - tracks.mean[step, slot]
        errors.append(error @ np.linalg.solve(tracks.covariance[step, slot].astype(float), error))
    return errors


def test_everything_happened_in_these_episodes(stepped, compared):
    assert any((~tracks.active.any(axis=1)).any() for _, tracks, *_ in stepped.values())
    values = compared[0].played["index"].values
    for metric in ("track_breaks", "gospa_false", "siap_spuriousness"):
        assert values[metric].max() > 0, metric
    assert values["truths_ever_tracked"].min() < 1
    # Without a track there is nothing to be consistent.
    assert np.isnan(compared[0].played["static"].values["nees"]).any()


def test_looks_are_counted(compared, stepped):
    # The first look of the index rule is the same in every episode: all is equally unknown.
    (azimuth, elevation), *_ = {tuple(actions[0]) for *_, actions in stepped.values()}
    played = compared[0].played["index"]
    assert played.looks.sum() == pytest.approx(1.0)
    assert played.looks[azimuth, elevation] >= 1 / LENGTH


def test_curves_are_means_with_two_standard_errors_over_the_episodes_that_have_a_value():
    sums = episodes.Sums(3, LOOKS)
    values = {metric: np.ones(2) for metric in METRICS}
    first = np.array([[1.0, np.nan, np.nan], [3.0, 7.0, np.nan]])
    second = np.array([[5.0, np.nan, np.nan], [7.0, np.nan, np.nan]])
    for chunk in (first, second):
        sums.add(values, dict.fromkeys(CURVES, chunk), np.array([[3, 3, 3], [3, 3, 14]]))
    curve = sums.result((), 1).curves["covariance_x"]
    np.testing.assert_allclose(curve.mean, [4.0, 7.0, np.nan])
    half = 1.96 * np.std([1, 3, 5, 7], ddof=1) / 2
    np.testing.assert_allclose(curve.low, [4 - half, np.nan, np.nan])
    np.testing.assert_allclose(curve.high, [4 + half, np.nan, np.nan])
    looks = sums.result((), 1).looks
    assert looks[0, 3] == pytest.approx(10 / 12)
    assert looks[3, 2] == pytest.approx(2 / 12)


def test_curves_are_those_of_the_episode(stepped):
    _, tracks, *_ = stepped[0]
    live = tracks.active[..., None]
    variances = np.diagonal(tracks.covariance, axis1=2, axis2=3)
    with np.errstate(invalid="ignore"):
        expected = np.where(live, variances, 0.0).sum(axis=1) / live.sum(axis=1)
    found = jax.jit(jax.vmap(episode_metrics.covariances))(tracks)
    for axis, name in enumerate(("covariance_x", "covariance_y", "covariance_z")):
        np.testing.assert_allclose(found[name], expected[:, 2 * axis], rtol=1e-5)
    assert np.isnan(found["covariance_norm"]).any()
    np.testing.assert_array_equal(np.isnan(found["covariance_norm"]), ~tracks.active.any(axis=1))


def test_nees_is_that_of_the_whole_matrix():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20, 6, 6)) * np.array([20.0, 30.0] * 3)[:, None]
    covariance = root @ np.swapaxes(root, 1, 2) + np.diag([1.0, 10.0] * 3)
    error = 10 * rng.normal(size=(20, 6))
    expected = np.einsum("ti,ti->t", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    np.testing.assert_allclose(nees(error, covariance), expected, rtol=5e-3)


def test_the_wait_is_counted_from_the_truths_first_step():
    alive = np.ones((6, 4), dtype=bool)
    alive[:3, 1] = False  # appears on the fourth step
    alive[:, 3] = False  # never lives
    tracked = np.zeros((6, 4), dtype=bool)
    tracked[0, 0] = True  # 1 step
    tracked[4:, 1] = True  # 2 steps
    # The third truth is never tracked: 6 steps.
    wait = mean_wait(alive, tracked, Params(time_step=0.5))
    assert wait == pytest.approx(0.5 * (1 + 2 + 6) / 3)


def test_looks_are_numbered_as_in_the_action():
    for continuous in (False, True):
        static = StaticParams(num_looks=5, continuous_actions=continuous)
        look = np.array([PARAMS.field_limit, -PARAMS.field_limit / 2 + 0.01])
        assert look_number(look, static, PARAMS) == 4 * 5 + 1


def test_planted_errors_change_the_table(compared, monkeypatch):
    comparison, _, compiled = compared
    monkeypatch.setattr(episodes, "compile_program", lambda *_: compiled)
    wrong_sign = PARAMS.replace(track_weight=-PARAMS.track_weight)
    monkeypatch.setattr(episodes, "MEMORY", SEVEN_EPISODES)
    turned = summarise(compare(COMPETITORS, ENV, wrong_sign, EPISODES, SEED).played).mean["index"]
    table = summarise(comparison.played).mean
    # Azimuth and elevation swapped: the rule looks beside its tracks.
    assert table["swapped"]["completeness"].high < table["index"]["completeness"].low
    assert table["swapped"]["gospa"].low > table["index"]["gospa"].high
    # The track term with the wrong sign: the return falls by twice that term, and nothing else changes.
    assert turned["episode_return"].high < table["index"]["episode_return"].low
    assert turned["gospa"] == table["index"]["gospa"]
