"""Comparison of policies on the same scenarios, its statistics and its files."""

import csv
import json

import jax
import numpy as np
import pytest
from rich.console import Console

from jaxtrack import Params, StaticParams, metrics
from jaxtrack.env import SearchTrack
from jaxtrack.policies import POLICIES
from train import evaluate
from train.evaluate import METRICS, interval, paired_difference, print_results, write_results

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(
    num_truths=3, max_tracks=4, max_detections=3, max_clutter=0, map_size=8, num_looks=4, reward="information"
)
LENGTH = 12
PARAMS = Params(max_steps_in_episode=LENGTH, time_step=0.05, beam_azimuth=0.9, beam_elevation=0.9)
ENV = SearchTrack(STATIC)


@pytest.fixture(scope="module")
def compared():
    """Results of three entries, two of them the same policy, and how often progress was told."""
    told = []
    policies = {name: POLICIES[name.split("-")[0]] for name in ("index", "static", "index-again")}
    results = evaluate.compare(policies, ENV, PARAMS, 5, 7, lambda: told.append(1))
    return results, told


def test_the_same_policy_meets_the_same_scenarios(compared):
    results, told = compared
    assert list(results) == ["index", "static", "index-again"]
    assert len(told) == 3
    for metric in METRICS:
        assert results["index"][metric].shape == (5,)
        np.testing.assert_array_equal(results["index"][metric], results["index-again"][metric])
    assert (results["index"]["completeness"] > results["static"]["completeness"]).any()
    # Scenarios differ from one another.
    assert len(set(results["index"]["gospa"])) == 5


def test_metrics_are_those_of_the_episode_played_step_by_step(compared):
    results, _ = compared
    key_reset, key_noise, key_policy = jax.random.split(jax.random.split(jax.random.key(7), 5)[2], 3)
    policy = POLICIES["index"](STATIC, PARAMS)

    @jax.jit
    def step(state, key):
        action = policy(key_policy, state)
        _, after, reward, _, _ = ENV.step_env(key, state, action, PARAMS)
        distance = metrics.gospa(after.truths, after.tracks, PARAMS).distance
        return after, (reward, distance, metrics.completeness(after.truths, after.tracks, PARAMS))

    _, state = ENV.reset_env(key_reset, PARAMS)
    steps = []
    for key in jax.random.split(key_noise, LENGTH):
        state, values = step(state, key)
        steps.append(values)
    reward, distance, completeness = np.array(steps).T
    of_episode = {metric: values[2] for metric, values in results["index"].items()}
    np.testing.assert_allclose(of_episode["episode_return"], reward.sum(), rtol=1e-4)
    np.testing.assert_allclose(of_episode["gospa"], distance.mean(), rtol=1e-4)
    np.testing.assert_allclose(of_episode["completeness"], completeness.mean(), rtol=1e-5)
    np.testing.assert_allclose(of_episode["track_to_target_ratio"], int(state.num_initiated) / 3, rtol=1e-6)


def test_an_interval_without_spread_is_its_mean():
    assert interval(np.full(5, 3.0)) == (3.0, 3.0, 3.0)
    assert interval(np.array([7.0])) == (7.0, 7.0, 7.0)


def test_an_interval_is_about_two_standard_errors_wide():
    values = np.random.default_rng(0).normal(10, 2, 400)
    mean, low, high = interval(values)
    assert mean == pytest.approx(values.mean())
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(mean - half, abs=0.1 * half)
    assert high == pytest.approx(mean + half, abs=0.1 * half)
    assert interval(values) == (mean, low, high)


# Own GOSPA against two others: 1 lower on every scenario, and better or worse by chance.
RESULTS = {
    "own": {metric: np.array([1.0, 2.0, 3.0, 6.0]) for metric in METRICS},
    "plus-one": {metric: np.array([2.0, 3.0, 4.0, 7.0]) for metric in METRICS},
    "other": {metric: np.array([6.0, 3.0, 2.0, 1.0]) for metric in METRICS},
}


def test_paired_differences_are_own_minus_other_scenario_by_scenario():
    differences = paired_difference(RESULTS, "own")
    assert set(differences) == {"plus-one", "other"}
    # All four differ by the same: no uncertainty, although the values themselves spread.
    assert differences["plus-one"] == (-1.0, -1.0, -1.0)
    mean, low, high = differences["other"]
    assert mean == 0.0
    assert low < -2
    assert high > 2


def test_files_hold_means_intervals_and_every_episode(tmp_path):
    write_results(RESULTS, tmp_path)
    summary = json.loads((tmp_path / "results.json").read_text())
    assert list(summary) == list(RESULTS)
    assert list(summary["own"]) == list(METRICS)
    mean, low, high = interval(np.array([1.0, 2.0, 3.0, 6.0]))
    assert summary["own"]["gospa"] == {"mean": mean, "low": low, "high": high}
    assert mean == 3.0
    rows = list(csv.DictReader((tmp_path / "episodes.csv").read_text().splitlines()))
    assert list(rows[0]) == ["policy", "episode", *METRICS]
    assert [(row["policy"], row["episode"]) for row in rows] == [
        (policy, str(episode)) for policy in RESULTS for episode in range(4)
    ]
    assert [float(row["completeness"]) for row in rows[8:]] == [6.0, 3.0, 2.0, 1.0]


def test_the_table_shows_every_policy_and_the_paired_differences(capsys):
    print_results(RESULTS, "own", Console(width=150))
    said = capsys.readouterr().out
    assert "4 scenarios, mean and half width of the 95 % interval" in said
    for words in ("plus-one", "other", *METRICS.values()):
        assert words in said
    assert "GOSPA of own minus plus-one: -1.0 m, 95 % interval [-1.0, -1.0]" in said


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--episodes", "0"], r"^episodes = 0: expected an integer >= 1$"),
        (["--seed", "-1"], r"^seed = -1: expected an integer >= 0$"),
        (["--run", "nowhere"], r"^run = 'nowhere': expected a folder with a config.json$"),
    ],
)
def test_the_command_refuses_wrong_options(argv, message):
    with pytest.raises(ValueError, match=message):
        evaluate.main(argv)
