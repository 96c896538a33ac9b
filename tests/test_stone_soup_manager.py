"""The example in which a policy of ours steers the radar of a Stone Soup simulation."""

import dataclasses

import numpy as np
import pytest

from examples.stone_soup_manager import ManagerOptions, chosen, judge, main, simulate
from jaxtrack import Params, StaticParams
from jaxtrack.policies import POLICIES
from tests.train.small_run import CONFIG, STATIC, random_state, write_run
from train.checkpoint import save
from train.saved_run import write_config

pytestmark = pytest.mark.usefixtures("quick_compilation")

SMALL = StaticParams(num_truths=3, max_tracks=6, map_size=12, num_looks=5)
NARROW = Params(field_limit=0.3, time_step=0.05)


def test_the_index_rule_finds_more_than_chance_and_a_seed_repeats_the_simulation():
    index, again, chance = (
        simulate(POLICIES[name], SMALL, NARROW, 60, seed=3) for name in ("index", "index", "random")
    )
    (complete, gospa), (less, more) = judge(index, NARROW), judge(chance, NARROW)
    assert complete > less > 0
    assert gospa < more
    assert judge(again, NARROW) == (complete, gospa)
    starts = [{tuple(map(float, path[0].state_vector)) for path in one.paths} for one in (index, chance)]
    assert starts[0] == starts[1]
    assert len(index.paths) == 3
    assert all(len(path) == 61 for path in index.paths)
    assert len(index.detections) > len(index.tracks) >= 3


def test_the_command_prints_both_managers_and_draws(tmp_path, capsys):
    picture = tmp_path / "picture.png"
    assert main(["--policy", "coverage", "--steps", "30", "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    rows = [line.split("│")[1].strip() for line in printed.splitlines() if "│ 30" in line]
    assert rows == ["coverage", "random"]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_trained_run_steers_in_the_scenario_that_it_was_trained_on(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    write_run(folder, random_state())
    options = ManagerOptions(run=folder, steps=5)
    name, build, static, params = chosen(options)
    assert (name, static) == (str(folder), STATIC)
    assert dataclasses.asdict(params) == dataclasses.asdict(CONFIG.params)
    played = simulate(build, static, params, 5, seed=0)
    assert len(played.paths) == STATIC.num_truths
    assert "using the checkpoint" in capsys.readouterr().out


def test_a_run_whose_scenario_is_not_simulated_is_refused(tmp_path):
    config = dataclasses.replace(CONFIG, params=dataclasses.replace(CONFIG.params, detection_probability=0.5))
    write_config(tmp_path, config)
    save(tmp_path, random_state(), config, "")
    with pytest.raises(ValueError, match="detection_probability = 1"):
        chosen(ManagerOptions(run=tmp_path))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policy": "best"}, "policy = 'best': expected one of random, static, coverage"),
        ({"steps": 1}, "steps = 1: expected an integer >= 2"),
        ({"seed": -1}, "seed = -1: expected an integer >= 0"),
        ({"run": "nowhere"}, "run = 'nowhere': expected a folder"),
        ({"picture": "no/such/place.png"}, "picture = "),
    ],
)
def test_wrong_options_are_named(fields, message):
    with pytest.raises(ValueError, match="^" + message):
        main([text for name, value in fields.items() for text in (f"--{name}", str(value))])


def test_the_metrics_are_those_of_the_parameters():
    played = simulate(POLICIES["coverage"], SMALL, NARROW, 10, seed=0)
    empty = played._replace(tracks=set())
    np.testing.assert_allclose(judge(empty, NARROW), (0.0, np.sqrt(3 * 200.0**2 / 2)))
