"""The benchmark of the metrics: the same episodes and the same values on both sides."""

import json

import jax
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import metrics
from benchmarks.metrics import MetricsOptions
from jaxtrack import Params, StaticParams
from reference.parity.records import Record

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=3, max_tracks=5, max_detections=4, map_size=12, num_looks=5)
# Five looks per axis cover the field only with a wide beam.
PARAMS = Params(beam_azimuth=0.7, beam_elevation=0.7, max_steps_in_episode=100)
OPTIONS = MetricsOptions(steps=40, batch=2, repeats=2, min_seconds=0.001, seed=1)


@pytest.fixture(scope="module")
def played():
    return metrics.episodes(STATIC, PARAMS, OPTIONS)


@pytest.fixture(scope="module")
def rows(played):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "episodes", lambda *_: played)
        return metrics.measure(OPTIONS, STATIC, PARAMS, Progress(disable=True))


def test_times_ratios_and_equal_values(rows):
    assert [row["metric"] for row in rows] == ["GOSPA", "SIAP"]
    for row in rows:
        for side in row["milliseconds"].values():
            assert len(side["repeats"]) == OPTIONS.repeats
            assert 0 < side["min"] <= side["median"] <= side["max"] < np.inf
        medians = {side: values["median"] for side, values in row["milliseconds"].items()}
        for side in ("alone", "batch"):
            assert row["ratios"][side] == pytest.approx(medians["stone_soup"] / medians[side])
        assert row["largest_difference"] < 1e-9
        assert row["compile_seconds"] > 0
    # Distance, three parts and switching at every step; seven totals and five ratios at every step.
    assert rows[0]["values"] == OPTIONS.repeats * 5 * OPTIONS.steps
    assert rows[1]["values"] == OPTIONS.repeats * (7 + 5 * OPTIONS.steps)


def test_the_episodes_differ_and_have_tracks(played):
    truths, tracks = played
    assert tracks.active.shape == (2, OPTIONS.steps, STATIC.max_tracks)
    assert np.all(tracks.active[:, -1].sum(axis=1) >= 2)
    assert not np.allclose(truths.state[0], truths.state[1])


def test_only_stone_soups_own_work_is_timed(played, monkeypatch):
    """Each look at the clock takes a second; making objects and reading values takes none."""
    truths, tracks = jax.tree.map(lambda leaf: leaf[0], played)
    stock = metrics.TimedRecord(Record(PARAMS, truths, tracks))
    clock = iter(range(100))
    monkeypatch.setattr(metrics.time, "perf_counter", lambda: float(next(clock)))
    metrics.stock_gospa(stock)
    assert stock.seconds == 1.0
    metrics.stock_siap(stock)
    assert stock.seconds == 2.0


def test_command_writes_all_and_prints_markdown(rows, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(metrics, "measure", lambda *_: rows)
    file = tmp_path / "result.json"
    assert metrics.main(["--out", str(file), "--markdown", "--steps", "77"]) == 0
    result = json.loads(file.read_text())
    assert {"date", "versions", "machine", "options", "scenario", "rows"} < set(result)
    assert result["rows"] == rows
    assert result["options"]["steps"] == 77
    assert str(tmp_path) not in file.read_text()
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert lines[0] == f"| {' | '.join(metrics.HEADER)} |"
    assert all(line.count("|") == len(metrics.HEADER) + 1 for line in lines[:4])
    assert "values are the same" in said


@pytest.mark.parametrize("wrong", [1e-5, np.nan])
def test_different_values_are_told(rows, monkeypatch, capsys, wrong):
    monkeypatch.setattr(metrics, "measure", lambda *_: [rows[0], {**rows[1], "largest_difference": wrong}])
    assert metrics.main([]) == metrics.DIFFERENT
    assert "DIFFERENT" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "2"], r"steps = 2: expected an integer in \[3, 1000\]"),
        (["--steps", "1001"], "steps = 1001"),
        (["--batch", "1"], "batch = 1"),
        (["--repeats", "0"], "repeats = 0"),
        (["--min-seconds", "nan"], "min_seconds = nan"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(metrics, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        metrics.main(arguments)
