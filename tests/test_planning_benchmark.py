"""The benchmark of the managers: the same track lists for all, complete in its file."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import planning
from benchmarks.planning import PlanningOptions
from jaxtrack import Params, StaticParams, make, report
from jaxtrack.managers import expected_falls
from jaxtrack.scan_map import look_grid

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=4, max_tracks=6, max_detections=4, map_size=12, num_looks=5)
# Five looks per axis cover the field only with a wide beam.
PARAMS = Params(beam_azimuth=0.7, beam_elevation=0.7)
OPTIONS = PlanningOptions(
    num_states=(3,), candidates=(3,), horizons=(2,), repeats=2, stone_soup_decisions=2, min_seconds=0.01
)


@pytest.fixture(scope="module")
def states():
    return planning.scenes(STATIC, PARAMS, 3, seed=1)


@pytest.fixture(scope="module")
def found(states):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "scenes", lambda static, params, count, seed: planning.first(count, states))
        return planning.measure(OPTIONS, STATIC, PARAMS, Progress(disable=True))


@pytest.mark.medium
def test_one_row_for_each_manager_and_number_of_states(found):
    cases = [(row["manager"], row["num_states"]) for row in found["rows"]]
    names = ["index", "uncertainty", "greedy", "rollout, 3 looks, 2 steps"]
    assert cases == [(planning.STONE_SOUP, 1), *((name, 3) for name in names)]


def test_agents_decide_on_what_they_were_trained_to_observe():
    options = dataclasses.replace(OPTIONS, runs=(Path("agents/beams"),))
    build = planning.managers(options)["agent, beams"]
    env, params = make()
    state = jax.eval_shape(env.reset_env, jax.random.key(0), params)[1]
    look = jax.eval_shape(lambda key, state: build(env.static, params)(key, state), jax.random.key(0), state)
    assert look.shape == (2,)
    with pytest.raises(ValueError, match="nowhere"):
        planning.managers(dataclasses.replace(OPTIONS, runs=(Path("nowhere"),)))


@pytest.mark.medium
def test_speeds_and_ratio(found):
    theirs = found["rows"][0]["decisions_per_second"]["median"]
    for row in found["rows"]:
        speed = row["decisions_per_second"]
        assert len(speed["repeats"]) == OPTIONS.repeats
        assert 0 < speed["min"] <= speed["median"] <= speed["max"] < np.inf
        assert row["ratio"] == pytest.approx(speed["median"] / theirs)


@pytest.mark.medium
def test_all_decide_on_tracks_and_alike(found, states):
    # A raster of wide beams has just found all truths.
    assert 3 <= found["live_tracks"] <= STATIC.num_truths
    assert np.all(states.time == STATIC.num_looks**2)
    assert found["different_decisions"] == 0


def test_different_decisions_are_counted(states):
    looks = look_grid(STATIC, PARAMS)
    falls = np.asarray(jax.jit(jax.vmap(lambda tracks: expected_falls(tracks, looks, PARAMS)))(states.tracks))
    best = [divmod(int(place), 5) for place in falls.argmax(axis=1)]
    worst = divmod(int(falls[1].argmin()), 5)
    assert planning.count_different(states, best, STATIC, PARAMS) == 0
    assert planning.count_different(states, [best[0], worst, best[2]], STATIC, PARAMS) == 1


def test_ours_counts_the_decisions_of_every_state(states, monkeypatch):
    """Each look at the clock takes a second: after four calls on three states, 4 s are over."""
    clock = iter(range(100))
    monkeypatch.setattr(planning.time, "perf_counter", lambda: float(next(clock)))
    calls = []
    speed = planning.time_ours(lambda *inputs: calls.append(inputs), states, min_seconds=5.0)
    assert len(calls) == 4
    assert speed == pytest.approx(4 * 3 / 5)


def test_speeds_are_written_without_exponents():
    assert [report.written(speed) for speed in (1.5, 43.48, 376.5, 53580.0)] == [
        "1.50",
        "43.5",
        "376",
        "53,580",
    ]


@pytest.mark.medium
def test_command_writes_all_and_prints_markdown(found, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(planning, "measure", lambda *_: {**found, "different_decisions": 0})
    file = tmp_path / "result.json"
    assert planning.main(["--out", str(file), "--markdown", "--num-states", "1", "3"]) == 0
    result = json.loads(file.read_text())
    assert set(result) == {"date", "versions", "machine", "options", "scenario", *found}
    assert result["rows"] == found["rows"]
    assert result["options"]["num_states"] == [1, 3]
    assert result["scenario"]["num_looks"] == StaticParams().num_looks
    assert str(tmp_path) not in file.read_text()
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert lines[0] == f"| {' | '.join(planning.HEADER)} |"
    assert all(line.count("|") == len(planning.HEADER) + 1 for line in lines[: 2 + len(found["rows"])])
    assert "choose alike" in said
    monkeypatch.setattr(planning, "measure", lambda *_: {**found, "different_decisions": 2})
    assert planning.main([]) == planning.DIFFERENT
    assert "DIFFERENTLY 2 times" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats = 0"),
        (["--num-states", "1", "0"], "num_states = 0"),
        (["--num-states", "4", "4"], r"num_states = \(4, 4\): expected different"),
        (["--candidates", "8", "362"], "candidates = 362: expected at most 361"),
        (["--horizons", "0"], "horizons = 0"),
        (["--stone-soup-decisions", "0"], "stone_soup_decisions = 0"),
        (["--min-seconds", "0"], "min_seconds = 0"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(planning, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        planning.main(arguments)
