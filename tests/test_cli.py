"""What all commands share: every mistake ends in one line that names it."""

import dataclasses
import json

import pytest

from jaxtrack.cli import BAD_USAGE, INTERRUPTED, parse, require_file, require_integer, run, take_config


@dataclasses.dataclass(frozen=True)
class Inner:
    """Nested options."""

    time_step: float = 0.5
    """Time between looks (s)."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Does something."""

    num_envs: int = 4
    """Environments side by side."""
    encoder: str = "cells"
    """Policy to train."""
    anneal: bool = True
    """Let the rate fall."""
    inner: Inner = dataclasses.field(default_factory=Inner)
    """Numbers."""


def command(argv):
    """A command as all of them are built: the file gives defaults, the command line wins."""
    values, rest = take_config(argv)
    inner = Inner(**values.pop("inner", {}))
    return parse(Options(**values, inner=inner), rest, "program")


def refusal(argv):
    """The message with which a command line is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # callers look at the message
        command(argv)
    message = str(caught.value)
    assert "\n" not in message
    assert not set("─│╭╮╰╯\x1b") & set(message)
    assert "full helptext" not in message
    return message


def test_options_are_read_from_the_command_line():
    assert command([]) == Options()
    argv = ["--num-envs", "8", "--inner.time-step", "-1", "--encoder=mhsa", "--no-anneal"]
    assert command(argv) == Options(8, "mhsa", False, Inner(-1.0))


def test_an_unknown_option_is_named_in_one_line():
    message = refusal(["--num-env", "8"])
    assert "--num-env" in message
    # tyro says what may have been meant.
    assert "--num-envs" in message


def test_a_number_that_is_none_is_named_in_one_line():
    message = refusal(["--num-envs", "many"])
    assert "--num-envs" in message
    assert "many" in message


def test_an_option_without_its_value_is_named_in_one_line():
    assert "--num-envs" in refusal(["--num-envs"])


def test_help_explains_every_option_and_exits_with_0(capsys):
    with pytest.raises(SystemExit) as stop:
        command(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    for words in ("Does something.", "--num-envs", "Environments side by side.", "--inner.time-step"):
        assert words in said


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("run.toml", 'num_envs = 8\nencoder = "mhsa"\n[inner]\ntime_step = 0.1\n'),
        ("run.json", json.dumps({"num_envs": 8, "encoder": "mhsa", "inner": {"time_step": 0.1}})),
    ],
)
def test_a_file_gives_the_defaults_and_the_command_line_wins(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    assert command(["--config", str(path)]) == Options(8, "mhsa", True, Inner(0.1))
    assert command([f"--config={path}"]) == Options(8, "mhsa", True, Inner(0.1))
    for argv in (
        ["--num-envs", "16", "--config", str(path)],
        ["--config", str(path), "--num-envs", "16"],
    ):
        assert command(argv) == Options(16, "mhsa", True, Inner(0.1))


def test_without_a_file_nothing_is_taken():
    assert take_config(["--num-envs", "8"]) == ({}, ["--num-envs", "8"])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("missing.toml", None, "No such file"),
        ("run.yaml", "num_envs: 8", "expected a .toml or .json file"),
        ("run", "num_envs: 8", "expected a .toml or .json file"),
        ("run.toml", "num_envs = = 8", "Invalid value"),
        ("run.json", '{"num_envs": 8', "delimiter"),
        ("run.json", "[1, 2]", "expected a table of fields"),
    ],
)
def test_a_file_that_can_not_be_read_is_named(tmp_path, name, text, words):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    message = refusal(["--config", str(path)])
    assert message.startswith(f"config = {str(path)!r}: ")
    assert words in message


def test_a_file_that_is_no_text_is_named(tmp_path):
    path = tmp_path / "run.json"
    path.write_bytes(b"\xff\xfe\x00")
    assert refusal(["--config", str(path)]).startswith(f"config = {str(path)!r}: ")


def test_config_without_a_file_name_is_refused():
    assert refusal(["--config"]).startswith("config: expected the name of a .toml or .json file")


def test_an_integer_that_is_too_small_is_named():
    require_integer("num_envs", 1, 1)
    with pytest.raises(ValueError, match="num_envs = 0: expected an integer >= 1"):
        require_integer("num_envs", 0, 1)


def test_a_place_where_no_file_can_be_written_is_named(tmp_path):
    require_file("out", tmp_path / "new.csv")
    (tmp_path / "old.csv").touch()
    require_file("out", tmp_path / "old.csv")
    for path in (tmp_path, tmp_path / "missing" / "new.csv"):
        with pytest.raises(ValueError, match="expected a file in a folder that exists") as caught:
            require_file("out", path)
        assert str(caught.value).startswith(f"out = {str(path)!r}: ")


def exit_code(monkeypatch, command, *argv):
    """Code with which the program ends."""
    monkeypatch.setattr("sys.argv", ["program", *argv])
    with pytest.raises(SystemExit) as stop:
        run(command)
    return stop.value.code


def test_a_command_gets_its_arguments_and_its_code_is_the_programs(monkeypatch):
    seen = []
    assert exit_code(monkeypatch, lambda argv: seen.extend(argv) or 7, "--a", "b") == 7
    assert seen == ["--a", "b"]


@pytest.mark.parametrize("error", [ValueError("num_envs = 0:\n expected  more"), OSError("disk is full")])
def test_wrong_input_is_one_line_on_standard_error_and_code_2(monkeypatch, capsys, error):
    def fail(argv):
        raise error

    assert exit_code(monkeypatch, fail) == BAD_USAGE == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"error: {' '.join(str(error).split())}\n"
    assert said.err.count("\n") == 1


def test_an_interrupt_ends_with_code_130(monkeypatch, capsys):
    def stop(argv):
        raise KeyboardInterrupt

    assert exit_code(monkeypatch, stop) == INTERRUPTED == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_programming_error_is_not_hidden(monkeypatch):
    def fail(argv):
        raise TypeError("bug")

    monkeypatch.setattr("sys.argv", ["program"])
    with pytest.raises(TypeError, match="bug"):
        run(fail)
