"""The benchmark of the environment: honest on both sides, complete in its file."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import environment, playing, stone_soup
from benchmarks.environment import EnvironmentOptions
from jaxtrack import Params, StaticParams, Truths, make, policies
from jaxtrack.report import PACKAGES
from reference.simulation import StoneSoupScenario
from reference.truths import initial_states, truth_simulator

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=4, max_tracks=8, max_detections=4, map_size=12, num_looks=7)
# Seven looks per axis cover the field only with a wide beam.
PARAMS = Params(beam_azimuth=0.5, beam_elevation=0.5)
OPTIONS = EnvironmentOptions(
    num_envs=(2,), repeats=2, steps=12, stone_soup_steps=12, min_seconds=0.01, seed=3
)


@pytest.fixture(scope="module")
def rows():
    return environment.measure(OPTIONS, STATIC, PARAMS, Progress(disable=True))


@pytest.mark.medium
def test_one_row_for_each_policy_and_number_of_environments(rows):
    cases = [(row["policy"], row["num_envs"]) for row in rows]
    assert cases == [("random", 2), ("pointing", 2)]


@pytest.mark.medium
def test_speeds_and_ratio(rows):
    for row in rows:
        medians = []
        for side in ("jaxtrack", "stone_soup"):
            speed = row[side]["steps_per_second"]
            assert len(speed["repeats"]) == OPTIONS.repeats
            assert 0 < speed["min"] <= speed["median"] <= speed["max"] < np.inf
            medians.append(speed["median"])
        assert row["ratio"] == pytest.approx(medians[0] / medians[1])
        assert row["compile_seconds"] > 0


@pytest.mark.medium
def test_pointing_detects_and_tracks_on_both_sides(rows):
    for row in rows[1:]:
        ours, theirs = row["jaxtrack"], row["stone_soup"]
        assert ours["detections_per_step"] >= 1.0
        assert theirs["detections_per_step"] >= 1.0
        assert ours["live_tracks"] == pytest.approx(theirs["live_tracks"], abs=1.0)
        assert ours["live_tracks"] == pytest.approx(STATIC.num_truths, abs=1.0)


def test_looks_follow_the_same_rules_on_both_sides():
    """Fed the same truths and the same time, both sides look at the same place."""
    env, params = make(PARAMS, STATIC)
    key = jax.random.key(0)
    _, state = env.reset(key, params)
    states = initial_states(np.random.default_rng(1), STATIC.num_truths, PARAMS)
    scenario = StoneSoupScenario(STATIC, PARAMS)
    scenario.reset(seed=0)
    scenario.truths = iter(truth_simulator(states, 0, PARAMS))
    scenario.paths = sorted(next(scenario.truths)[1], key=lambda path: path[-1].state_vector[0])
    order = states[np.argsort(states[:, 0])]
    truths = Truths(state=jnp.asarray(order), alive=jnp.ones(len(order), dtype=bool))
    rng = np.random.default_rng(0)
    seen = set()
    for step in range(2 * STATIC.num_looks + 1):
        scenario.step_index = step
        state = state.replace(time=jnp.asarray(step), truths=truths)
        pairs = {
            "pointing": (playing.pointing, stone_soup.pointing_look),
            "raster": (policies.coverage, stone_soup.raster_look),
        }
        for name, (build, look) in pairs.items():
            theirs = tuple(int(index) for index in look(scenario, rng))
            assert tuple(build(STATIC, params)(key, state).tolist()) == theirs, name
            seen.add((name, theirs))
    assert sum(name == "pointing" for name, _ in seen) >= 3


def test_random_looks_cover_the_field_on_both_sides():
    scenario = StoneSoupScenario(STATIC, PARAMS)
    rng = np.random.default_rng(0)
    field = {(i, j) for i in range(STATIC.num_looks) for j in range(STATIC.num_looks)}
    assert {tuple(stone_soup.random_look(scenario, rng).tolist()) for _ in range(1000)} == field
    ours = playing.random_actions(jax.random.split(jax.random.key(0), 3), 1000, STATIC, PARAMS)
    assert ours.shape == (1000, 3, 2)
    for looks in np.moveaxis(np.asarray(ours), 1, 0):
        assert {tuple(look) for look in looks.tolist()} == field
    assert np.mean(ours[:, 0] == ours[:, 1]) < 0.3  # every environment has its own


def test_without_a_policy_looks_are_random():
    """With one look again and again most of the map would stay as it was at the start."""
    env, params = make(PARAMS, STATIC)
    keys = jax.random.split(jax.random.key(0), 4)
    (_, end), _ = playing.play(keys, playing.begin(keys, params, env), params, env, None, 40)
    seen = np.asarray(end.scan_map) < 1
    assert np.all(np.mean(seen, axis=(1, 2)) > 0.8)


def test_ours_counts_every_step_of_every_environment(monkeypatch):
    """A call of 12 steps of 3 environments that takes 2 s makes 18 steps/s."""
    clock = iter(range(0, 100, 2))
    monkeypatch.setattr(environment.time, "perf_counter", lambda: float(next(clock)))
    env, params = make(PARAMS, STATIC)
    start = playing.begin(jax.random.split(jax.random.key(0), 3), params, env)

    def played(*_):
        return start, {"num_detections": jnp.asarray(0.5), "live_tracks": jnp.asarray(2.0)}

    played.input_shardings = jax.devices()[0], {}
    timing = environment.time_ours(played, jax.random.key(0), start, params, OPTIONS)
    assert timing == environment.Timing(steps_per_second=18.0, detections=0.5, live_tracks=2.0)


@pytest.mark.parametrize(
    ("num_envs", "shared", "expected"), [(4, True, [1]), (4, False, []), (3, True, []), (1, True, [])]
)
def test_environments_are_shared_out_where_they_can_and_may_be(monkeypatch, num_envs, shared, expected):
    asked = []

    def share_out(function, shared):
        asked.append(shared)
        return function

    monkeypatch.setattr(playing.cores, "share_out", share_out)
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    monkeypatch.setattr(playing, "play", lambda keys, start, *_: (start, {}))
    env, params = make(PARAMS, STATIC)
    start = playing.begin(jax.random.split(jax.random.key(0), num_envs), params, env)
    playing.compile_play(env, params, start, playing.pointing, 3, shared=shared)
    assert asked == expected


@pytest.mark.medium
def test_command_writes_all_and_prints_markdown(rows, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(environment, "measure", lambda *_: rows)
    file = tmp_path / "result.json"
    assert environment.main(["--out", str(file), "--markdown", "--num-envs", "1", "3"]) == 0
    result = json.loads(file.read_text())
    assert set(result) == {"date", "versions", "machine", "options", "scenario", "rows"}
    assert set(result["versions"]) == {"python", *PACKAGES}
    assert set(result["machine"]) == {"processor", "cores", "system", "jax_backend"}
    assert result["rows"] == rows
    assert result["options"]["num_envs"] == [1, 3]
    assert result["scenario"]["num_truths"] == StaticParams().num_truths
    assert result["scenario"]["time_step"] == Params().time_step
    assert str(tmp_path) not in file.read_text()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| policy | environments | jaxtrack, steps/s | Stone Soup, steps/s | ratio |")
    assert lines[1] == "|" + " --- |" * len(environment.HEADER)
    assert f"{rows[1]['ratio']:,.0f}" in lines[3]
    assert all(line.count("|") == len(environment.HEADER) + 1 for line in lines[:4])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repeats", "0"], "repeats = 0"),
        (["--num-envs", "1", "0"], "num_envs = 0"),
        (["--num-envs", "4", "4"], r"num_envs = \(4, 4\): expected different"),
        (["--stone-soup-steps", "639"], "stone_soup_steps = 639: expected at most 638"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
        (["--nonsense"], "nonsense"),
    ],
)
def test_wrong_options_end_before_anything_is_measured(arguments, message, monkeypatch):
    monkeypatch.setattr(environment, "measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ValueError, match=message):
        environment.main(arguments)
