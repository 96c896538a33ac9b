"""The benchmark of what one more costs: one axis at a time, lines that fit, complete in its file."""

import dataclasses
import json
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import scaling, scaling_fit
from benchmarks.scaling import Case, ScalingOptions
from benchmarks.scaling_fit import AXES
from jaxtrack import Params, StaticParams

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=3, max_tracks=4, max_detections=3, max_clutter=2, map_size=8, num_looks=5)
PARAMS = Params(beam_azimuth=0.7, beam_elevation=0.7)
DEFAULT = ScalingOptions()
OPTIONS = ScalingOptions(num_envs=(2, 4), repeats=2, steps=2, min_seconds=0.001)


def rows_of(costs):
    """What `measure` returns, with the given cost (µs per step of all), and two disturbed repeats."""
    programs, rows = {}, []
    for axis in AXES:
        cases = scaling.cases_along(axis, DEFAULT, StaticParams())
        for case in cases.values():
            programs[case] = SimpleNamespace(live_tracks=10.0, compile_seconds=5.0)
        times = {case: [3 * costs(case), costs(case), 2 * costs(case)] for case in cases.values()}
        rows.append(scaling.make_row(axis, cases, times, programs))
    return rows


def modelled(case):
    """A step of an environment costs 2 µs and 0.1 µs for each slot; all together 30 µs more."""
    return 30.0 + case.num_envs * (2.0 + 0.1 * case.static.max_tracks + 1e-4 * case.static.map_size**2)


@pytest.fixture(scope="module")
def rows():
    return rows_of(modelled)


def test_the_lines_find_what_one_more_costs(rows):
    found = {row["axis"]: row["fit"] for row in rows}
    each = 2.0 + 0.1 * 20 + 1e-4 * 48**2
    assert found["num_envs"] == pytest.approx(
        {"one_more": each, "fixed": 30.0, "largest_misfit": 0}, abs=1e-6
    )
    shared = 30.0 / 64
    assert found["max_tracks"]["one_more"] == pytest.approx(0.1)
    assert found["max_tracks"]["fixed"] == pytest.approx(each - 2 + shared)
    assert found["map_size"]["one_more"] == pytest.approx(1e-4)
    assert found["num_truths"]["one_more"] == pytest.approx(0, abs=1e-9)
    assert found["devices"] is None


def test_small_costs_count_in_the_fit():
    line = scaling_fit.fit([1, 10, 1000], [2.0, 11.0, 2000.0])
    assert line["largest_misfit"] < 0.5
    assert scaling_fit.fit([1, 2, 3], [1.0, 2.0, 6.0])["largest_misfit"] == pytest.approx(0.4, abs=0.1)


def test_one_axis_at_a_time(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    base = Case(StaticParams(), 64)
    for axis in AXES:
        cases = scaling.cases_along(axis, DEFAULT, StaticParams())
        assert base in cases.values()
        for value, case in cases.items():
            differing = {
                name for name, default in vars(base.static).items() if getattr(case.static, name) != default
            }
            differing |= {name for name in ("num_envs", "devices") if vars(case)[name] != vars(base)[name]}
            assert differing <= {axis.name}
            assert {**vars(case.static), **vars(case)}[axis.name] == value
    assert list(cases) == [1, 2]
    assert cases[2].devices == 2


def test_a_number_of_environments_that_devices_can_not_share_has_no_such_case(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    options = dataclasses.replace(DEFAULT, num_envs=(1, 63))
    assert list(scaling.cases_along(AXES[-1], options, StaticParams())) == [1]


@pytest.mark.medium
def test_measuring(monkeypatch):
    axes = [axis for axis in AXES if axis.name in ("num_envs", "max_tracks")]
    monkeypatch.setattr(scaling, "AXES", axes)
    options = dataclasses.replace(OPTIONS, max_tracks=(4, 6))
    rows = scaling.measure(options, STATIC, PARAMS, Progress(disable=True))
    assert [(row["axis"], row["values"]) for row in rows] == [("num_envs", [2, 4]), ("max_tracks", [4, 6])]
    for row in rows:
        assert all(len(cost["repeats"]) == 2 and 0 < cost["min"] < np.inf for cost in row["microseconds"])
        assert all(seconds > 0 for seconds in row["compile_seconds"])
        # Every truth was pointed at before the clock started.
        assert all(live == pytest.approx(STATIC.num_truths, abs=1) for live in row["live_tracks"])
    # The default is measured once for all axes.
    share = rows[0]["microseconds"][1]["median"] / rows[1]["microseconds"][0]["median"]
    assert share == pytest.approx(4)


def test_a_step_is_one_of_many_in_a_call(monkeypatch):
    """Each look at the clock takes a second: two calls of 5 steps in 3 s."""
    program = object.__new__(scaling.Program)
    program.compiled, program.keys, program.start, program.params = lambda *_: (), 0, 0, 0
    program.steps = 5
    clock = iter(range(100))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    assert program.time(min_seconds=3.0) == pytest.approx(1e6 * 3 / 2 / 5)


def test_command_writes_draws_and_prints_markdown(rows, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scaling, "measure", lambda *_: rows)
    file, figure = tmp_path / "result.json", tmp_path / "scaling.png"
    arguments = ["--out", str(file), "--figure", str(figure), "--markdown", "--max-tracks", "10", "30"]
    assert scaling.main(arguments) == 0
    result = json.loads(file.read_text())
    assert set(result) == {"date", "versions", "machine", "options", "scenario", "rows"}
    assert result["rows"] == rows
    assert result["options"]["max_tracks"] == [10, 30]
    assert str(tmp_path) not in file.read_text()
    assert figure.stat().st_size > 10_000
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"| {' | '.join(scaling.HEADER)} |"
    assert lines[3].startswith("| track slot | 0.100 | one environment |")
    assert all(line.count("|") == len(scaling.HEADER) + 1 for line in lines[: 2 + len(AXES)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--num-envs", "64"], r"num_envs = \(64,\): expected at least two"),
        (["--map-size", "8", "8", "9"], "map_size = .*expected at least two different"),
        (["--num-truths", "0", "5"], "num_truths = 0"),
        (["--max-tracks", "20", "201"], r"max_tracks = 201: expected an integer in \[1, 200\]"),
        (["--steps", "251"], r"steps = 251: expected an integer in \[1, 250\]"),
        (["--repeats", "0"], "repeats = 0"),
        (["--min-seconds", "-1"], "min_seconds = -1"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
        (["--figure", "x.txt"], "figure = 'x.txt': expected a file ending in .png"),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(scaling, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        scaling.main(arguments)
