"""The soak of the environment sees what must not happen, and tells what it checked."""

import dataclasses
import json
import math

import jax
import numpy as np
import pytest
from rich.progress import Progress

from benchmarks import soak, soaking
from benchmarks.soak import SoakOptions
from benchmarks.soaking import CASES, Soaked
from jaxtrack import Params, StaticParams

pytestmark = pytest.mark.usefixtures("quick_compilation")

STATIC = StaticParams(num_truths=5, max_tracks=4, max_detections=3, max_clutter=8, map_size=8, num_looks=5)
PARAMS = Params(beam_azimuth=0.7, beam_elevation=0.7, max_steps_in_episode=50)
KEYS = jax.random.split(jax.random.key(0), 9)


def start(name):
    return Soaked(CASES[name], STATIC, PARAMS, num_envs=2, steps=20)


@pytest.fixture(scope="module")
def crowded():
    """All slots are full of false tracks after three calls, in the second episode."""
    played = start("clutter")
    assert [played.advance(key) for key in KEYS[:3]] == [[], [], []]
    return played


def spoilt(crowded, **fields):
    """What is wrong in a call of the same program with other numbers; the program stays as it was."""
    kept = {name: getattr(crowded, name) for name in ("params", "state", "traces", "smallest_eigenvalue")}
    crowded.params = crowded.params.replace(**fields)
    try:
        return crowded.advance(KEYS[5])
    finally:
        vars(crowded).update(kept)


def test_a_crowd_fills_all_slots_and_is_traced_once(crowded):
    assert crowded.steps == 3 * 2 * 20
    assert crowded.traces == 1
    assert crowded.most_live == STATIC.max_tracks
    assert crowded.dropped > 100
    assert 0 < crowded.smallest_eigenvalue < 1 / 6


def test_no_angle_at_all_does_no_harm():
    played = start("edges")
    assert played.advance(KEYS[0]) == []
    policy = played.policy
    angles = np.array([policy(key, played.state.replace(time=0)) for key in jax.random.split(KEYS[1], 60)])
    assert np.any(np.isnan(angles))
    assert np.any(np.isinf(angles))
    assert np.any(angles == np.float32(PARAMS.field_limit))


def test_a_planted_nan_is_caught_and_named(crowded):
    found = spoilt(crowded, process_noise=math.nan)
    assert any(line.startswith("state.tracks.covariance is not finite in steps ") for line in found)
    assert any(line.startswith("observation.tracks is not finite") for line in found)
    assert not any("scan_map" in line or "truths" in line for line in found)


def test_a_planted_infinity_is_caught(crowded):
    assert any("reward" in line for line in spoilt(crowded, track_weight=math.inf))


def test_a_planted_negative_variance_is_caught(crowded):
    found = spoilt(crowded, process_noise=-1e6)
    assert any("a variance is -" in line or "an eigenvalue is -" in line for line in found)


def test_an_indefinite_covariance_is_caught(crowded):
    state = crowded.state
    tracks = state.tracks
    wrong = tracks.covariance.at[..., 0, 2].set(1e6).at[..., 2, 0].set(1e6)
    crowded.state = state.replace(tracks=tracks.replace(covariance=wrong))
    found = crowded._wrong_covariances()
    crowded.state = state
    assert len(found) == 1
    assert found[0].startswith("an eigenvalue is -")


def test_a_second_trace_is_told(crowded):
    assert spoilt(crowded, process_noise=1) == ["traced 2 times"]


class Scripted:
    """Stands for `Soaked`: plays nothing, and does what a test says on one of its calls."""

    calls, at_call, event = 0, 0, None

    def __init__(self, case, static, params, num_envs, steps):
        self.steps, self.per_call, self.traces = 0, num_envs * steps, 1
        self.most_live, self.dropped, self.smallest_eigenvalue = 7, 0, 0.01

    def advance(self, key):
        Scripted.calls += 1
        if Scripted.calls == Scripted.at_call:
            if Scripted.event is KeyboardInterrupt:
                raise KeyboardInterrupt
            return [Scripted.event]
        self.steps += self.per_call
        return []


@pytest.fixture
def script(monkeypatch):
    """Two cases, scripted; returns how to say what happens when."""
    monkeypatch.setattr(soak, "Soaked", Scripted)
    monkeypatch.setattr(soak, "CASES", {"one": CASES["random"], "other": CASES["random"]})

    def say(event=None, at_call=0):
        for name, value in {"event": event, "at_call": at_call, "calls": 0}.items():
            monkeypatch.setattr(Scripted, name, value)

    say()
    return say


ARGUMENTS = ["--num-envs", "2", "--steps-per-call", "10", "--steps", "1e3", "--markdown"]


def test_all_well(script, tmp_path, capsys):
    file = tmp_path / "soak.json"
    assert soak.main([*ARGUMENTS, "--out", str(file)]) == 0
    result = json.loads(file.read_text())
    assert result["steps"] == 1000
    assert result["violations"] == []
    assert [row["steps"] for row in result["rows"]] == [500, 500]
    assert len(result["memory"]) == 2
    said = capsys.readouterr().out
    assert said.splitlines()[0] == f"| {' | '.join(soak.HEADER)} |"
    assert "1,000 steps" in said
    assert "nothing was wrong" in said


def test_what_is_wrong_ends_it_with_exit_code_1(script, capsys):
    script("state.time is not finite", at_call=20)
    assert soak.main(ARGUMENTS) == soak.VIOLATED
    assert "VIOLATED: other: state.time is not finite" in capsys.readouterr().out
    assert Scripted.calls == 20


@pytest.mark.parametrize("at_call", [1, 3, 21])
def test_an_interrupt_reports_what_was_checked(script, capsys, at_call):
    script(KeyboardInterrupt, at_call)
    assert soak.main(ARGUMENTS) == 130
    said = capsys.readouterr().out
    assert f"interrupted; {20 * (at_call - 1):,} steps" in said
    assert "nothing was wrong" in said


def test_growing_memory_is_told(script, monkeypatch, capsys):
    sizes = iter(range(500, 10_000, 30))
    monkeypatch.setattr(soak, "resident_memory", lambda: float(next(sizes)))
    assert soak.main(ARGUMENTS) == soak.VIOLATED
    assert "memory grew from 500 MB to 590 MB" in capsys.readouterr().out


def test_memory_is_that_of_the_process():
    before = soak.resident_memory()
    held = np.ones(10_000_000)
    assert soak.resident_memory() - before == pytest.approx(held.nbytes / 1e6, rel=0.3)


def test_every_case_is_played(monkeypatch):
    """The real cases take their fields, up to the point where they would be compiled."""
    monkeypatch.setattr(soaking.Soaked, "advance", lambda self, key: ["stop"])
    options = dataclasses.replace(SoakOptions(), num_envs=2, steps_per_call=2)
    found = soak.soak(options, StaticParams(), Params(), Progress(disable=True))
    assert set(found.cases) == set(CASES)
    assert found.violations[: len(CASES)] == [f"{name}: stop" for name in CASES]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steps", "0"], "steps = 0.0: expected a number > 0"),
        (["--steps", "inf"], "steps = inf"),
        (["--num-envs", "0"], "num_envs = 0"),
        (["--steps-per-call", "0"], "steps_per_call = 0"),
        (["--allowed-growth", "nan"], "allowed_growth = nan"),
        (["--seed", "-1"], "seed = -1"),
        (["--out", "no/such/folder/x.json"], "out = "),
    ],
)
def test_wrong_options_end_before_anything_is_played(arguments, message, monkeypatch):
    monkeypatch.setattr(soak, "soak", lambda *_: pytest.fail("played"))
    with pytest.raises(ValueError, match=message):
        soak.main(arguments)
