"""Scenarios by name: each trains, evaluates and renders; and what a name or a file is taken for."""

import csv
import os
import re
import signal

import jax
import numpy as np
import pytest

import jaxtrack
from jaxtrack import render
from jaxtrack.recording import record_episode
from jaxtrack.scenarios import SCENARIOS, read_scenario
from tests.aircraft_file import state_rows, write_states
from tests.train.small_run import OPTIONS, assert_same_result
from train import evaluate, ppo
from train.agents import agent_policy
from train.metrics_file import MetricsFile
from train.saved_run import load_run

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 3
RECORDING = "a recording"
"""Beside the names: a file of aircraft."""
MEDIUM, MEDIUM_TO_DRAW = ("accelerating",), ("accelerating", "turning", "swarm", "flying")
"""Those that CI plays and draws; the others run with -m slow."""
QUICKLY_DRAWN = ("continuous",)
"""That which is always drawn."""
OF_SCENARIOS = ("num-truths", "max-tracks", "max-detections", "max-clutter")
SMALL = {name: value for name, value in OPTIONS.items() if name.removeprefix("static.") not in OF_SCENARIOS}
WORDS = [word for option, value in SMALL.items() for word in (f"--{option}", str(value))]
LEARN = ["--total-steps", "64", "--warm-start-steps", "32", "--evaluation-episodes", "0"]


def each(names, medium=MEDIUM, quick=()):
    def marks(name):
        return () if name in quick else pytest.mark.medium if name in medium else pytest.mark.slow

    return [pytest.param(name, marks=marks(name)) for name in names]


def assert_has_fields(name, static, params):
    made = vars(static) | vars(params)
    assert {field: made[field] for field in SCENARIOS[name]} == SCENARIOS[name]


@pytest.fixture
def short(monkeypatch):
    """Episodes of a few steps on a small map, whatever the scenario."""

    def cut(name):
        return {**read_scenario(name), "max_steps_in_episode": STEPS, "map_size": 6, "num_looks": 3}

    for module in ("jaxtrack.render", "train.scenarios"):
        monkeypatch.setattr(f"{module}.read_scenario", cut)


def train(name, folder, *more):
    """Trains an agent for two updates, and gives its folder and the exit code."""
    scenario = str(write_states(folder / "states.csv", state_rows(12))) if name == RECORDING else name
    run = folder / "run"
    return run, ppo.main(["--scenario", scenario, *WORDS, *LEARN, "--out", str(run), *more])


@pytest.fixture(scope="module", params=each([*SCENARIOS, RECORDING]))
def trained(request, quick_compilation, tmp_path_factory):
    """A scenario, and the folder of an agent that was trained on it."""
    run, code = train(request.param, tmp_path_factory.mktemp("runs"))
    assert code == 0
    return request.param, run


def test_each_trains(trained):
    name, run = trained
    config, env, _ = load_run(run)
    if name == RECORDING:
        assert config.params.trajectories.shape == (7, env.static.num_truths, 6)
    else:
        assert_has_fields(name, env.static, config.params)
    assert len((run / "metrics.csv").read_text().splitlines()) == 3  # what is not finite ends it before


@pytest.mark.slow
def test_each_agent_is_evaluated_and_drawn(trained, monkeypatch, tmp_path):
    _, run = trained
    shown = []
    monkeypatch.setattr(evaluate, "print_results", lambda comparison, *_: shown.append(comparison.played))
    assert evaluate.main(["--run", str(run), "--policies", "random", "--episodes", "2"]) == 0
    assert list(shown[0]) == ["beams", "random"]
    assert all(np.isfinite(one.values["gospa"]).all() for one in shown[0].values())
    config, env, weights = load_run(run)
    policy = agent_policy(config.encoder, weights, head=config.head)(env.static, config.params)
    episode = record_episode(env, config.params, policy, jax.random.key(0))
    assert render.animate(episode, tmp_path / "agent.gif", stride=2) == 3
    assert (tmp_path / "agent.gif").stat().st_size > 10_000


@pytest.mark.slow
def test_angles_of_looks_are_learned_as_their_numbers_are(tmp_path):
    metrics = []
    for name in ("paper", "continuous"):
        (tmp_path / name).mkdir()
        run, _ = train(name, tmp_path / name)
        rows = csv.DictReader((run / "metrics.csv").read_text().splitlines())
        own = ("reward", "policy_loss", "entropy", "gradient_norm", "value_loss")
        metrics.append([[float(row[column]) for column in own] for row in rows])
    np.testing.assert_allclose(metrics[1], metrics[0], rtol=1e-3)


@pytest.mark.slow
def test_any_angle_may_be_learned_and_played(tmp_path):
    head = ["--encoder", "flatten", "--head", "gaussian", "--static.map-size", "36"]
    run, code = train("continuous", tmp_path, *head)
    assert code == 0
    for more in ([], ["--greedy"]):
        assert evaluate.main(["--run", str(run), "--policies", "random", "--episodes", "2", *more]) == 0
    config, env, weights = load_run(run)
    policy = agent_policy(config.encoder, weights, head=config.head)(env.static, config.params)
    looks = record_episode(env, config.params, policy, jax.random.key(0)).records.look
    assert len(np.unique(looks)) == looks.size
    assert np.abs(looks).max() <= config.params.field_limit


@pytest.mark.slow
def test_a_training_on_a_recording_resumes_as_if_it_had_not_stopped(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("whole", "stopped")]
    for folder in folders:
        folder.mkdir()
    whole, _ = train(RECORDING, folders[0])
    write = MetricsFile.write

    def write_and_stop(self, row):
        write(self, row)
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsFile, "write", write_and_stop)
        stopped, code = train(RECORDING, folders[1])
    assert code == 130
    assert ppo.main(["--resume", str(stopped)]) == 0
    assert_same_result(stopped, whole)


@pytest.mark.parametrize("name", each(SCENARIOS))
def test_each_evaluates(name, short, monkeypatch, capsys):
    played, play = [], evaluate.play

    def spy(competitors, env, params, *rest):
        played.append((env.static, params))
        return play(competitors, env, params, *rest)

    monkeypatch.setattr(evaluate, "play", spy)
    policies = ["--policies", "random", "index_tuned", "sweep"]
    assert evaluate.main([*policies, "--episodes", "2", "--scenario", name]) == 0
    assert "2 scenarios" in capsys.readouterr().out
    assert_has_fields(name, *played[0])


@pytest.mark.parametrize("name", each(SCENARIOS, MEDIUM_TO_DRAW, QUICKLY_DRAWN))
def test_each_renders(name, short, monkeypatch, tmp_path):
    drawn, save_frame = [], render.save_frame

    def spy(episode, path):
        drawn.append(episode)
        save_frame(episode, path)

    monkeypatch.setattr(render, "save_frame", spy)
    out = tmp_path / "last.png"
    assert render.main(["--scenario", name, "--steps", str(STEPS), "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000
    assert_has_fields(name, drawn[0].static, drawn[0].params)


@pytest.mark.parametrize("name", SCENARIOS)
def test_each_is_made_of_its_fields(name):
    env, params = jaxtrack.make(**read_scenario(name))
    assert_has_fields(name, env.static, params)


@pytest.mark.parametrize("options", [evaluate.EvaluateOptions, ppo.Options])
def test_every_help_names_them_all(options, capsys):
    command = evaluate if options is evaluate.EvaluateOptions else ppo
    with pytest.raises(SystemExit):
        command.main(["--help"])
    said = capsys.readouterr().out
    assert ", ".join(SCENARIOS) in re.sub(r"[\s│]+", " ", said)


def test_options_win_over_the_scenario_and_the_scenario_over_the_file(monkeypatch, tmp_path):
    (tmp_path / "mine.toml").write_text("seed = 7\n[params]\nclutter_rate = 0.1\nrange_sigma = 9\n")
    given = []
    monkeypatch.setattr(ppo, "start_run", given.append)
    options = ["--scenario", "clutter", "--config", str(tmp_path / "mine.toml")]
    ppo.open_run([*options, "--params.detection-probability", "0.7"])
    (config,) = given
    params = config.params
    assert (config.seed, params.clutter_rate, params.detection_probability) == (7, 0.2, 0.7)
    assert (params.range_sigma, params.search_weight) == (9, 3.0)


def test_what_can_not_be_trained_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^scenario: expected none beside --resume"):
        ppo.open_run(["--resume", str(tmp_path), "--scenario", "slow"])
    (tmp_path / "typed.json").write_text('{"num_truths": 1, "trajectories": [[[1, 2, 3, 4, 5, 6]]]}')
    with pytest.raises(ValueError, match=r"^scenario = '.*typed.json': expected trajectories in a .csv file"):
        ppo.open_run(["--scenario", str(tmp_path / "typed.json")])


def test_fields_of_a_file_may_stand_in_tables_or_alone(tmp_path):
    (tmp_path / "mixed.json").write_text(
        '{"num_looks": 5, "static": {"map_size": 9}, "clutter_rate": 0.5, "info_metrics": ["gospa"]}'
    )
    assert read_scenario(str(tmp_path / "mixed.json")) == {
        "num_looks": 5,
        "map_size": 9,
        "clutter_rate": 0.5,
        "info_metrics": ("gospa",),
    }
    (tmp_path / "wrong.json").write_text('{"static": 3}')
    with pytest.raises(ValueError, match=r"^static = 3: expected a table of fields"):
        read_scenario(str(tmp_path / "wrong.json"))


def test_the_aircraft_of_a_recording_are_the_truths(short, tmp_path):
    recorded = write_states(tmp_path / "states.csv", state_rows(12))
    env, params = jaxtrack.make(**read_scenario(str(recorded)))
    assert 1 <= env.static.num_truths <= 4
    key = jax.random.key(0)
    episode = record_episode(env, params, lambda key, state: np.array([9, 9]), key, num_steps=2)
    np.testing.assert_allclose(episode.states.truths.state, params.trajectories[1:3], rtol=1e-5)
    out = tmp_path / "aircraft.png"
    assert render.main(["--scenario", str(recorded), "--steps", "2", "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000


@pytest.mark.parametrize("name", ["moon", "paper.txt", ""])
def test_another_name_is_refused_with_all_that_exist(name):
    with pytest.raises(ValueError, match=f"^scenario = '{name}': expected {', '.join(SCENARIOS)}, or a"):
        read_scenario(name)
