"""The command `python -m train.evaluate`: what it takes, what it refuses, what it leaves."""

import csv
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.cli import run
from jaxtrack.managers import MANAGERS
from jaxtrack.policies import POLICIES
from tests.train.compared import THREE
from train import evaluate
from train.config import TrainConfig
from train.evaluate import COMPARED_SEED, baselines, check_shapes, group_runs, told_apart
from train.figures import FIGURES
from train.scenarios import build_scenario

pytestmark = pytest.mark.usefixtures("quick_compilation")

TINY = """
max_steps_in_episode = 6
beam_azimuth = 0.9
[static]
num_truths = 2
max_tracks = 3
max_detections = 2
max_clutter = 0
map_size = 6
num_looks = 3
"""


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """Folder after the whole command."""
    folder = tmp_path_factory.mktemp("evaluated")
    (folder / "tiny.toml").write_text(TINY)
    options = ["--policies", "random", "greedy", "--episodes", "3", "--scenario", str(folder / "tiny.toml")]
    page = folder / "pages" / "results.md"
    assert evaluate.main([*options, "--out", str(folder / "out"), "--page", str(page)]) == 0
    return folder


def test_the_command_leaves_tables_curves_figures_and_a_page(evaluated):
    out = evaluated / "out"
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["results.json", "episodes.csv", "curves.npz", *(f"{name}.png" for name in FIGURES)]
    )
    found = json.loads((out / "results.json").read_text())
    assert list(found["policies"]) == ["random", "greedy planner"]
    assert found["seed"] == COMPARED_SEED
    assert found["scenario"]["params"]["beam_azimuth"] == 0.9
    assert found["scenario"]["static"]["num_looks"] == 3
    rows = list(csv.DictReader((out / "episodes.csv").read_text().splitlines()))
    assert [row["policy"] for row in rows] == ["random"] * 3 + ["greedy planner"] * 3
    mean = found["policies"]["random"]["metrics"]["gospa"]["mean"]["value"]
    assert mean == pytest.approx(np.mean([float(row["gospa"]) for row in rows[:3]]), rel=1e-6)
    page = (evaluated / "pages" / "results.md").read_text()
    for name in FIGURES:
        assert f"]({Path('..') / 'out' / f'{name}.png'})" in page
    assert "python -m train.evaluate --policies random greedy --episodes 3" in page
    assert "| greedy planner |" in page


def test_without_out_nothing_is_written(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate, "play", lambda *arguments: THREE)
    assert evaluate.main(["--policies", "random"]) == 0
    assert list(tmp_path.iterdir()) == []
    assert "4 scenarios" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "0"], "episodes = 0: expected an integer in [1, 1000000]"),
        (["--seed", "-1"], "seed = -1: expected an integer in [0, 4294967295]"),
        (["--run", "nowhere"], "run = 'nowhere': expected a folder with a config.json"),
        (["--runs", "nowhere", "else"], "run = 'nowhere': expected a folder with a config.json"),
        (
            ["--policies", "index", "best"],
            "policies = 'best': expected all, planners, or some of random, static, coverage, stalest, "
            "scheduler, index, index_tuned, gain, sweep, sweep_then_track, greedy, rollout, "
            "uncertainty",
        ),
        (["--policies"], "policies: expected at least one name, or a run"),
        (["--scenario", "moon"], "scenario = 'moon': expected paper, clutter, births, agile, turning, "),
        (["--scenario", "moon.csv"], "scenario = 'moon.csv': No such file"),
        (["--scenario", "moon.toml"], "config = 'moon.toml': "),
        (["--scenario", "wrong.json"], "nonsense: no such field"),
        (["--scenario", "negative.json"], "time_step = -1: expected a number in (0"),
        (["--page", "results.md"], "page: expected a folder for its figures too, --out"),
        (["--episodes", "few"], "--episodes"),
    ],
)
def test_bad_input_is_one_line_and_code_2(monkeypatch, tmp_path, capsys, options, message):
    (tmp_path / "wrong.json").write_text('{"nonsense": 1}')
    (tmp_path / "negative.json").write_text('{"time_step": -1}')
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["evaluate", *options])
    with pytest.raises(SystemExit) as stop:
        run(evaluate.main)
    assert stop.value.code == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: ")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_a_scenario_by_name_changes_its_fields_and_no_other_default():
    env, params = build_scenario("swarm", [])
    assert env.static == dataclasses.replace(
        TrainConfig().static, num_truths=50, max_tracks=100, max_detections=20
    )
    assert params == TrainConfig().params
    assert build_scenario("slow", [])[1] == dataclasses.replace(TrainConfig().params, time_step=0.05)


def test_runs_bring_their_own_scenario_unless_one_is_named():
    slow = TrainConfig(params=Params(time_step=0.05), static=StaticParams(num_truths=4))
    env, params = build_scenario("", [slow, dataclasses.replace(slow, seed=1)])
    assert (env.static.num_truths, params.time_step) == (4, 0.05)
    assert build_scenario("paper", [slow])[1].time_step == 0.005
    with pytest.raises(ValueError, match=r"^scenario: expected one by name, the runs were trained on diff"):
        build_scenario("", [slow, TrainConfig()])


def test_a_run_must_fit_the_scenario():
    config = TrainConfig(static=StaticParams(max_tracks=7))
    check_shapes(Path("runs/a"), config, StaticParams(max_tracks=7, num_truths=3, max_clutter=2))
    with pytest.raises(ValueError, match=r"^runs = 'runs/a': trained with max_tracks = 7, scenario has 20$"):
        check_shapes(Path("runs/a"), config, StaticParams())


def test_runs_that_differ_in_their_seed_are_one_policy():
    beams = TrainConfig(out="a")
    longer = dataclasses.replace(beams, total_steps=10**7)
    mhsa = TrainConfig(encoder="mhsa", seed=4)
    runs = [
        (Path("x/a"), beams, "weights of a"),
        (Path("x/m"), mhsa, "weights of m"),
        (Path("x/b"), dataclasses.replace(beams, seed=1, out="b"), "weights of b"),
    ]
    grouped = group_runs(runs, greedy=False)
    assert list(grouped) == ["beams", "mhsa"]
    assert grouped["beams"].seeds == (0, 1)
    assert grouped["beams"].weights == ["weights of a", "weights of b"]
    assert grouped["mhsa"].seeds == (4,)
    assert list(group_runs([*runs, (Path("x/l"), longer, "l")], False)) == ["beams (a)", "mhsa", "beams (l)"]
    with pytest.raises(ValueError, match=r"^runs = 'x/again': seed 0 of this policy is given twice$"):
        group_runs([*runs, (Path("x/again"), beams, "again")], greedy=False)


def test_policies_of_one_encoder_are_told_apart_by_their_paths():
    several = [
        (Path(folder) / "seed0", TrainConfig(total_steps=steps), folder)
        for folder, steps in (("r/a", 10**6), ("r/b", 2 * 10**6))
    ]
    grouped = group_runs(several, greedy=False)
    assert {name: one.weights for name, one in grouped.items()} == {
        "beams (a/seed0)": ["r/a"],
        "beams (b/seed0)": ["r/b"],
    }
    assert told_apart([]) == []
    assert told_apart([Path("a"), Path("b/a")]) == ["a", "b/a"]
    assert told_apart([Path("/c/a/x"), Path("/d/a/x")]) == ["c/a/x", "d/a/x"]


def test_baselines_come_once_and_in_the_order_asked_for(monkeypatch):
    assert list(baselines(["static", "random", "static"])) == ["static", "random"]
    monkeypatch.setattr(evaluate, "POLICIES", {"one": None, "two": None})
    assert list(baselines(["all"])) == ["one", "two"]
    assert baselines([]) == {}


def test_planners_have_names_of_their_own():
    found = baselines(["index", "planners", "greedy"])
    assert list(found) == ["index", "greedy planner", "rollout planner", "uncertainty planner"]
    assert {name: one.build(()) for name, one in found.items()} == {
        "index": POLICIES["index"],
        **{f"{name} planner": builder for name, builder in MANAGERS.items()},
    }


def test_a_training_is_compared_with_rules_only(monkeypatch):
    monkeypatch.setattr(evaluate, "play", lambda competitors, *arguments: list(competitors))
    assert evaluate.compare_with_baselines("own", *[None] * 6) == ["own", *POLICIES]


def test_help_names_every_policy(capsys):
    with pytest.raises(SystemExit):
        evaluate.main(["--help"])
    said = capsys.readouterr().out
    words = set(re.findall(r"\w+", said[: said.index("--run")]))
    assert words >= {"all", "planners", *POLICIES, *MANAGERS}
