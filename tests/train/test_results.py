"""What a comparison says: summary, files and table."""

import csv
import json

import numpy as np
import pytest
from rich.console import Console

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from tests.train.compared import STEPS, THREE
from train.episode_metrics import CURVES, METRICS
from train.results import format_estimate, print_results, summarise, write_results
from train.statistics import Estimate


@pytest.fixture(scope="module")
def summary():
    return summarise(THREE.played)


@pytest.fixture(scope="module")
def folder(summary, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    write_results(THREE, summary, SearchTrack(StaticParams()), Params(time_step=0.5), 3, folder)
    return folder


def test_the_summary_holds_every_pair_and_the_right_way_round(summary):
    assert summary.mean["own"]["gospa"].value == 4.0
    assert summary.interquartile_mean["static"]["gospa"].value == 2.5
    assert summary.differences["own", "random"]["completeness"] == (-1.0, -1.0, -1.0)
    assert summary.differences["random", "own"]["completeness"] == (1.0, 1.0, 1.0)
    assert set(summary.differences) == {(a, b) for a in THREE.played for b in THREE.played if a != b}
    # Less GOSPA is better and more completeness: one seed is below random, the other level.
    assert summary.improvement["gospa"]["own"]["random"].value == 0.75
    assert summary.improvement["completeness"]["own"]["random"].value == 0.25
    assert np.isnan(summary.mean["static"]["nees"]).all()


def test_results_json_holds_estimates_and_circumstances(folder):
    found = json.loads((folder / "results.json").read_text())
    assert found["seed"] == 3
    assert found["episodes"] == 4
    assert found["seconds"] == {"compiling": 2.0, "playing": 4.0}
    assert found["versions"]["jax"]
    assert found["machine"]["cores"] >= 1
    assert found["scenario"]["params"]["time_step"] == 0.5
    assert found["scenario"]["static"]["num_looks"] == 19
    assert list(found["policies"]) == list(THREE.played)
    own = found["policies"]["own"]
    assert own["training_seeds"] == [0, 7]
    assert list(own["metrics"]) == list(METRICS)
    gospa = own["metrics"]["gospa"]
    assert gospa["mean"]["value"] == 4.0
    assert gospa["mean"]["low"] < 4 < gospa["mean"]["high"]
    assert gospa["by_training_seed"] == [3.0, 5.0]
    assert gospa["interquartile_mean"]["value"] == pytest.approx(3.75)
    assert found["policies"]["static"]["metrics"]["nees"]["mean"] == dict.fromkeys(Estimate._fields)
    assert found["differences"]["own"]["random"]["gospa"]["high"] == -1.0
    assert found["probability_of_improvement"]["gospa"]["own"]["random"]["value"] == 0.75


def test_episodes_csv_holds_every_episode(folder):
    rows = list(csv.DictReader((folder / "episodes.csv").read_text().splitlines()))
    assert list(rows[0]) == ["policy", "training_seed", "episode", *METRICS]
    assert [(row["policy"], row["training_seed"], row["episode"]) for row in rows] == [
        (policy, seed, str(episode))
        for policy, seed in (("own", "0"), ("own", "7"), ("random", ""), ("static", ""))
        for episode in range(4)
    ]
    assert [float(row["completeness"]) for row in rows[12:]] == [6.0, 3.0, 2.0, 1.0]
    assert [float(row["gospa"]) for row in rows[4:8]] == [3.0, 4.0, 5.0, 8.0]
    assert rows[12]["nees"] == ""


def test_curves_npz_holds_every_step(folder):
    found = np.load(folder / "curves.npz")  # nothing in it is pickled
    assert found["policies"].tolist() == list(THREE.played)
    assert found["curves"].tolist() == list(CURVES)
    np.testing.assert_allclose(found["time"], 0.5 * np.arange(1, STEPS + 1))
    assert found["values"].shape == (3, len(CURVES), 3, STEPS)
    np.testing.assert_allclose(found["values"][0, 2, :, 5], [9.0, 8.0, 10.0])
    np.testing.assert_allclose(found["looks"][:, 2, 0], 0.75)


def test_the_table_shows_every_policy_the_speed_and_the_paired_differences(summary, capsys):
    print_results(THREE, summary, ["own"], Console(width=150))
    said = capsys.readouterr().out
    assert "4 scenarios, mean and half width of the 95 % interval" in said
    for words in ("random", "static", *METRICS.values()):
        assert words in said
    assert "compiled in 2.0 s; played 16 episodes in 4.0 s (4.0 episodes/s)" in said
    assert "GOSPA of own minus random: -1.0 m, 95 % interval [-1.0, -1.0]" in said
    assert "GOSPA of random minus" not in said
    assert "GOSPA of own by training seed: 0: 3.0, 7: 5.0 m; standard deviation 1.4 m" in said
    assert said.count("by training seed") == 1


def test_numbers_have_the_digits_that_are_worth_reading():
    assert format_estimate(Estimate(0.1234, 0.1, 0.2)) == "0.123 ± 0.050"
    assert format_estimate(Estimate(-123.46, -124.0, -123.0)) == "-123.5 ± 0.5"
    assert format_estimate(Estimate(12345.6, 12000.0, 13000.0)) == "12346 ± 500"
    assert format_estimate(Estimate(2.0, np.nan, np.nan)) == "2.000"
    assert format_estimate(Estimate(np.nan, np.nan, np.nan)) == "-"
