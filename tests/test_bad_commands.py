"""Whatever is put in, on the command line and in files: one line that names it, never a stack trace."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxtrack import cli, render, track
from jaxtrack.detection_file import read_detections
from train import evaluate, ppo
from train.config import check

COLUMNS = "time,elevation,bearing,range\n"
many = settings(max_examples=max(100, settings.default.max_examples))
ACCEPTED = 77
"""Code with which a command ends here where it would begin its work."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a file of detections and a file without any sense."""
    made = tmp_path_factory.mktemp("commands")
    (made / "in.csv").write_text(COLUMNS + "0,0.1,0.1,1000\n")
    (made / "junk").write_bytes(bytes(range(256)))
    return made


@pytest.fixture
def ended(folder, monkeypatch, capsys):
    """Runs a command, without its work, and returns its code; a wrong end fails the test."""

    def begin(*arguments, **named):
        raise SystemExit(ACCEPTED)

    def start_run(config, *number):
        check(config)
        begin()

    monkeypatch.chdir(folder)
    monkeypatch.setattr(track, "track_file", begin)
    monkeypatch.setattr(render, "draw", begin)
    monkeypatch.setattr(evaluate, "play", begin)
    monkeypatch.setattr(ppo, "start_run", start_run)
    monkeypatch.setattr(ppo, "start_seeds", start_run)

    def end(command, argv):
        monkeypatch.setattr("sys.argv", [command.__name__, *argv])
        with pytest.raises(SystemExit) as stop:
            cli.run(command.main)
        said = capsys.readouterr().err
        assert stop.value.code in (0, cli.BAD_USAGE, ACCEPTED)
        if stop.value.code == cli.BAD_USAGE:
            assert said.startswith("error: "), said
            assert len(said) > len("error: ?\n")
            assert said.count("\n") == 1
        return stop.value.code, said

    return end


OPTIONS = {
    track: ["in.csv", "--out", "--set", "--config", "--plot"],
    render: ["--policy", "--seed", "--steps", "--out", "--fps", "--stride"],
    evaluate: ["--policies", "--run", "--episodes", "--seed", "--scenario", "--greedy", "--out", "--page"],
    ppo: [
        *[
            "--encoder",
            "--seed",
            "--seeds",
            "--out",
            "--resume",
            "--config",
            "--num-envs",
            "--learning-rate",
            "--anneal",
        ],
        *["--static.max-tracks", "--static.reward", "--params.time-step", "--params.initial-truths"],
    ],
}
words = st.one_of(
    st.sampled_from(["", "-1", "0", "nan", "inf", "1e400", "9" * 30, "9" * 5000, "alpha=", "=", "alpha=1_0"]),
    st.sampled_from(
        ["in.csv", "junk", ".", "/", "no/such.gif", "no.toml", "x" * 300 + ".gif", "o.csv", "\0.png"]
    ),
    st.text(max_size=8),
    st.integers().map(str),
    st.floats().map(str),
)


@many
@given(st.sampled_from(list(OPTIONS)), st.data())
def test_any_command_line_ends_in_one_line_or_begins(ended, command, data):
    argv = ["in.csv", "--out", "o.csv"] if command is track and data.draw(st.booleans()) else []
    for option in data.draw(st.lists(st.sampled_from(OPTIONS[command]), max_size=3)):
        argv += [option, *data.draw(st.lists(words, max_size=2))]
    ended(command, argv)


values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-(10**320), 10**320), st.floats(), st.text(max_size=4)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=4), inner, max_size=2)
    ),
    max_leaves=6,
)
names = st.sampled_from(
    [
        *["alpha", "time_step", "initial_truths", "trajectories", "stop_threshold", "max_steps_in_episode"],
        *["max_tracks", "reward", "info_metrics", "continuous_actions", "params", "static", "encoder", "out"],
    ]
)
tables = st.dictionaries(names, st.one_of(values, st.dictionaries(names, values, max_size=3)), max_size=3)
COMMANDS_WITH_FILES = {
    track: ["in.csv", "--out", "o.csv", "--config"],
    evaluate: ["--policies", "random", "--scenario"],
    ppo: ["--config"],
}


@many
@given(st.sampled_from(list(COMMANDS_WITH_FILES)), tables)
def test_any_table_of_fields_is_refused_in_one_line_or_taken(ended, folder, command, table):
    (folder / "run.json").write_text(json.dumps(table))
    ended(command, [*COMMANDS_WITH_FILES[command], "run.json"])


@many
@given(
    st.sampled_from(list(COMMANDS_WITH_FILES)),
    st.sampled_from(["run.json", "run.toml"]),
    st.one_of(st.binary(max_size=40), st.text("{}[]\":,=.#\n1ea '", max_size=40).map(str.encode)),
)
def test_any_bytes_in_a_file_of_fields_are_refused_in_one_line_or_taken(
    ended, folder, command, name, content
):
    (folder / name).write_bytes(content)
    ended(command, [*COMMANDS_WITH_FILES[command], name])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"alpha": ' + "[" * 100_000, "recursion"),
        ('{"alpha": 1, "alpha": 2}', "alpha is given twice"),
        ('{"alpha": ' + "9" * 5000 + "}", "Exceeds the limit"),
        ('{"alpha": ' + "9" * 400 + "}", "expected a number in (0, 1e+09]"),
        ('{"alpha": NaN}', "alpha = nan: expected a number in (0, 1e+09]"),
    ],
)
def test_files_that_once_ended_in_a_stack_trace_or_in_silence(ended, folder, content, message):
    (folder / "run.json").write_text(content)
    code, said = ended(track, [*COMMANDS_WITH_FILES[track], "run.json"])
    assert code == cli.BAD_USAGE
    assert message in said
    assert ended(evaluate, [*COMMANDS_WITH_FILES[evaluate], "run.json"])[0] == cli.BAD_USAGE


def test_a_table_that_is_none_is_refused_beside_a_field_of_it(ended, folder):
    (folder / "run.json").write_text('{"params": null, "alpha": 1}')
    _, said = ended(evaluate, [*COMMANDS_WITH_FILES[evaluate], "run.json"])
    assert said == "error: params = None: expected a table of fields\n"


def test_a_file_that_begins_with_a_byte_order_mark_is_read(ended, folder):
    (folder / "run.json").write_bytes(b'\xef\xbb\xbf{"alpha": 1.0}')
    assert ended(track, [*COMMANDS_WITH_FILES[track], "run.json"])[0] == ACCEPTED


@pytest.mark.parametrize(
    ("command", "argv", "message"),
    [
        (render, ["--seed", str(2**32)], "seed = 4294967296: expected an integer in [0, 4294967295]"),
        (render, ["--steps", "9" * 20], "expected an integer in [1, 1000000]"),
        (render, ["--fps", "1000"], "fps = 1000: expected an integer in [1, 100]"),
        (render, ["--steps", "5", "--stride", "6"], "stride = 6: expected an integer in [0, 5]"),
        (render, ["--out", "\0.gif"], "expected a file in a folder that exists"),
        (evaluate, ["--seed", str(2**32)], "seed = 4294967296: expected an integer in [0, 4294967295]"),
        (evaluate, ["--out", "in.csv"], "out = 'in.csv': expected a folder"),
        (evaluate, ["--out", "new", "--page", "."], "page = '.': expected a file"),
        (ppo, ["--params.alpha", "1e300"], "alpha = 1e+300: expected a number in (0, 1e+09]"),
        (ppo, ["--static.max-tracks", "9" * 20], "expected an integer in [1, 10000]"),
    ],
)
def test_values_that_would_fail_only_after_the_work(ended, command, argv, message):
    code, said = ended(command, argv)
    assert code == cli.BAD_USAGE
    assert message in said


cells = st.one_of(
    st.sampled_from(["", "nan", "inf", "-inf", "0", "1", "1e300", "1e-320", "-1", "1_0", "0x1", '"', "\0"]),
    st.floats(-2, 10).map(str),
    st.text(max_size=4),
)


@many
@given(
    st.one_of(
        st.binary(max_size=60),
        st.binary(max_size=20).map(lambda junk: COLUMNS.encode() + b"0,0.1,0.2,1000\n" + junk),
        st.lists(st.lists(cells, min_size=3, max_size=5), max_size=4).map(
            lambda rows: (COLUMNS + "".join(",".join(row) + "\n" for row in rows)).encode()
        ),
    )
)
def test_any_file_of_detections_is_read_or_the_line_is_named(folder, content):
    path = folder / "detections.csv"
    path.write_bytes(content)
    try:
        recorded = read_detections(path)
    except ValueError as error:
        assert str(error).startswith(f"{path}, line "), error  # noqa: PT017  # both ends are fine
    else:
        assert recorded.count.sum() == len(recorded.value)
        assert np.all(np.diff(recorded.time) > 0)
        elevation, bearing, distance = recorded.value.T
        assert np.all(np.abs(elevation) <= math.pi / 2)
        assert np.all((-math.pi <= bearing) & (bearing <= 2 * math.pi))
        assert np.all((distance > 0) & np.isfinite(distance))
