"""The filter's errors are those of its covariances; models that are wrong by a factor of two are seen."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks import consistency
from benchmarks.consistency import band, judge
from benchmarks.matched import CASES, Errors, simulate_case
from jaxtrack.types import DETECTION_DIM, STATE_DIM

pytestmark = pytest.mark.usefixtures("quick_compilation")

RUNS, STEPS = 400, 30
CASE = CASES["10 km, ahead"]


def verdicts(case=CASE, start="prior", **world):
    """Whether NEES and NIS are inside, in a world in which these numbers are multiplied."""
    own = case.params()
    changed = dataclasses.replace(
        own, **{name: factor * getattr(own, name) for name, factor in world.items()}
    )
    errors = simulate_case(case, start, RUNS, STEPS, jax.random.key(0), changed)
    return (
        judge(np.asarray(errors.nees), STATE_DIM)["inside"],
        judge(np.asarray(errors.nis), DETECTION_DIM)["inside"],
    )


@pytest.mark.parametrize("name", ["1 km, ahead", "5 km, aside and above", "10 km, behind"])
def test_the_filter_is_consistent(x64, name):
    assert verdicts(CASES[name]) == (True, True)


def test_the_filter_is_consistent_in_float32():
    assert verdicts() == (True, True)


def test_the_initiator_is_consistent(x64):
    assert verdicts(start="detection") == (True, True)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_process_noise_is_seen(x64, factor):
    assert verdicts(truth_process_noise=factor)[0] is False


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_measurement_noise_is_seen(x64, factor):
    sigmas = ("elevation_sigma", "bearing_sigma", "range_sigma")
    assert verdicts(**dict.fromkeys(sigmas, math.sqrt(factor))) == (False, False)


def test_bands_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    means = rng.chisquare(6, (20_000, 50)).mean(axis=1)
    low, high = band(6, 50, 0.95)
    assert np.mean((low <= means) & (means <= high)) == pytest.approx(0.95, abs=0.006)
    assert band(6, 1, 0.95) == pytest.approx(chi2.ppf((0.025, 0.975), 6))


def test_judging():
    values = np.random.default_rng(1).chisquare(3, (8, 1000))
    fair = judge(values, 3)
    assert fair["inside"]
    assert fair["ratio"] == pytest.approx(values.mean() / 3)
    assert fair["half_width"] == pytest.approx(1.96 * math.sqrt(2 / 3 / 8000), rel=0.1)
    assert fair["means"] == pytest.approx(values.mean(axis=1))
    # One step that is wrong does not pass for the mean of all.
    values[4] *= 1.3
    wrong = judge(values, 3, comparisons=64)
    assert not wrong["inside"]
    assert wrong["farthest_step"] == 5
    # Nor does a little bias of all steps pass because none of them is far out.
    assert not judge(1.08 * np.random.default_rng(2).chisquare(3, (8, 1000)), 3)["inside"]


def test_command_writes_and_prints_markdown(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(consistency, "CASES", {"near": CASE, "far": CASE})
    errors = np.random.default_rng(3).chisquare(6, (5, 50))  # right for NEES, twice as large for NIS
    seen = []

    def simulate(case, start, runs, steps, key):
        seen.append((start, runs, steps, jax.config.jax_enable_x64))
        return Errors(nees=errors, nis=errors)

    monkeypatch.setattr(consistency, "simulate_case", simulate)
    file = tmp_path / "consistency.json"
    assert consistency.main(["--runs", "50", "--steps", "5", "--markdown", "--out", str(file)]) == 0
    assert [each[0] for each in seen] == ["prior", "prior", "detection", "detection"] * 2
    assert [each[3] for each in seen] == [True] * 4 + [False] * 4
    rows = json.loads(file.read_text())["rows"]
    assert len(rows) == 8
    assert rows[0]["nees"]["inside"]
    assert not rows[0]["nis"]["inside"]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"| {' | '.join(consistency.HEADER)} |"
    assert "| near | prior | float64 |" in lines[2]
    assert f"BIASED by {100 * (errors.mean() / 3 - 1):+.1f} %" in lines[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "1"], "runs = 1: expected an integer >= 2"),
        (["--steps", "0"], "steps = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_simulated(arguments, message, monkeypatch):
    monkeypatch.setattr(consistency, "measure_all", lambda *_: pytest.fail("simulated"))
    with pytest.raises(ValueError, match=message):
        consistency.main(arguments)
