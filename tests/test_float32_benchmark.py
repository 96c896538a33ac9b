"""Breakage is found and counted as it is; the square-root form has none in an extreme case."""

import json

import numpy as np
import pytest

from benchmarks import float32
from benchmarks.extremes import Case, Estimates, simulate
from benchmarks.float32 import errors, inspect, measure_filter

pytestmark = pytest.mark.usefixtures("quick_compilation")

TAME, EXTREME = Case(1e4, 2e-3, 5.0, 30.0), Case(100.0, 1e-6, 1e-6, 1e6)


@pytest.fixture(scope="module")
def rows(quick_compilation):
    seen = [simulate(case, 4, 25, np.random.default_rng(0)) for case in (TAME, EXTREME)]
    return measure_filter("extended", np.stack(seen), (TAME, EXTREME))


def test_the_full_form_breaks_in_the_extreme_case_alone(rows):
    assert rows[0]["float32 full"]["negative"] == 0
    assert rows[1]["float32 full"]["negative"] == 4
    assert rows[1]["float32 full"]["smallest_eigenvalue"] < -1e-3


def test_the_square_root_form_breaks_in_neither(rows):
    for row in rows:
        found = row["float32 square_root"]
        assert (found["not_finite"], found["negative"]) == (0, 0)
        assert found["smallest_variance"] > 0
        assert found["smallest_eigenvalue"] > -1e-6


def test_errors_against_float64(rows):
    """In the tame case both forms are good, and the square-root form has the better covariance."""
    full, factored = (rows[0][f"float32 {form}"] for form in ("full", "square_root"))
    assert full["compared"] == factored["compared"] == 4
    assert 0 < factored["mean"] < 5e-3
    assert 0 < factored["covariance"] < full["covariance"] < 5e-3


def test_inspecting():
    mean, covariance = np.zeros((3, 4, 6)), np.tile(np.eye(6), (3, 4, 1, 1))
    sound = inspect(mean, covariance)
    assert sound.report() == {
        "not_finite": 0,
        "negative": 0,
        "smallest_variance": 1.0,
        "smallest_eigenvalue": pytest.approx(1 / 6),
    }
    mean[1, 0, 3] = np.inf
    covariance[2, 1, 0, 1] = np.nan
    covariance[0, 2, 5, 5] = -2.0
    covariance[2, 3, 0, 1] = covariance[2, 3, 1, 0] = 3.0  # no variance is negative, an eigenvalue is
    sound = inspect(mean, covariance)
    np.testing.assert_array_equal(sound.not_finite, [True, True, False, False])
    np.testing.assert_array_equal(sound.negative, [False, False, True, False])
    assert sound.smallest_variance == -2.0
    assert sound.smallest_eigenvalue == pytest.approx(-1 / 3)


def test_errors_are_in_sigmas():
    covariance = np.tile(np.diag([4.0, 1, 1, 1, 1, 9]), (1, 1, 2, 1, 1))
    one = Estimates(np.zeros((1, 1, 2, 6)), covariance.copy())
    one.mean[0, 0, 0, 0], one.covariance[0, 0, 1, 0, 5] = 1.0, 3.0
    of_mean, of_covariance = errors(one, Estimates(np.zeros((1, 1, 2, 6)), covariance), 0)
    np.testing.assert_allclose(of_mean, [0.5, 0.0])
    np.testing.assert_allclose(of_covariance, [0.0, 0.5])


def test_simulated_detections_are_those_of_the_case():
    seen = simulate(EXTREME, 5, 10, np.random.default_rng(1))
    assert seen.shape == (11, 5, 3)
    np.testing.assert_allclose(seen[0, :, 2], 100.0, atol=1e-5)
    assert np.all(np.abs(seen[..., 2] - 100.0) < 20)
    assert Case(1.0, 2e-3, 5.0, 30.0).params().range_sigma == 0.01


def test_command_writes_and_prints_markdown(rows, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(float32, "FILTERS", ("extended",))
    monkeypatch.setattr(float32, "CASES", (TAME, EXTREME))
    monkeypatch.setattr(float32, "measure_filter", lambda name, seen, cases: rows)
    file = tmp_path / "float32.json"
    assert float32.main(["--tracks", "4", "--updates", "3", "--markdown", "--out", str(file)]) == 0
    assert json.loads(file.read_text())["rows"] == rows
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"| {' | '.join(float32.HEADER)} |"
    (broken,) = (line for line in lines if line.startswith("| extended | 1e+06 | float32 | full |"))
    assert "| 4 negative |" in broken
    (accuracy,) = (line for line in lines if line.startswith("| 10,000 | 0.002 | 5 | square_root |"))
    assert f"{rows[0]['float32 square_root']['mean']:.0e}; " in accuracy


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tracks", "0"], "tracks = 0: expected an integer >= 1"),
        (["--updates", "0"], "updates = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_simulated(arguments, message, monkeypatch):
    monkeypatch.setattr(float32, "measure_all", lambda *_: pytest.fail("simulated"))
    with pytest.raises(ValueError, match=message):
        float32.main(arguments)
