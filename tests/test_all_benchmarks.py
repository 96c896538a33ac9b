"""`make bench`: all parts, each by itself, and none stops another."""

import importlib
import inspect
import json

import pytest

from benchmarks import __main__ as bench

GOOD = """
import pathlib, sys
assert sys.argv[1:4] == ["--size", "3", "--markdown"]
pathlib.Path(sys.argv[sys.argv.index("--out") + 1]).write_text('{"ratio": 7}')
print("| speed |")
"""
BAD = """
import sys
print("| half |")
sys.exit("no luck")
"""


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """Two parts in the place of the real ones, as modules of their own."""
    (tmp_path / "good_part.py").write_text(GOOD)
    (tmp_path / "bad_part.py").write_text(BAD)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(bench, "PARTS", {"bad": ("bad_part",), "good": ("good_part", "--size", "3")})
    return tmp_path


def test_a_part_that_fails_stops_no_other(parts, capsys):
    out = parts / "results" / "today"
    out.mkdir(parents=True)
    (out / "bad.json").write_text("{}")
    assert bench.main(["--out", str(out), "--parts", "bad", "good"]) == bench.FAILED
    assert json.loads((out / "good.json").read_text()) == {"ratio": 7}
    assert not (out / "bad.json").exists()
    tables = (out / bench.TABLES).read_text()
    assert "FAILED with exit code 1: no luck" in tables
    assert "| half |" in tables
    assert "`python -m good_part --size 3`" in tables
    assert tables.index("| half |") < tables.index("| speed |")
    assert str(parts) not in tables
    assert "FAILED: bad" in capsys.readouterr().out


def test_all_well(parts, capsys):
    out = parts / "new" / "folder"
    assert bench.main(["--out", str(out), "--parts", "good"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["good.json", bench.TABLES]
    said = capsys.readouterr().out
    assert "| speed |" in said
    assert "all went well" in said


@pytest.mark.parametrize("part", bench.PARTS)
def test_every_part_has_the_options_it_is_given(part, monkeypatch):
    """The real parts take their options, up to the point where they would measure."""
    name, *arguments = bench.PARTS[part]
    module = importlib.import_module(name)
    seen = []

    def stop(*values):
        seen.append(values)
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "measure", stop)
    with pytest.raises(KeyboardInterrupt):
        module.main(arguments)
    assert len(seen) == 1
    assert inspect.getdoc(module)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--parts", "tracker", "nonsense"], "parts = 'nonsense': expected any of environment, tracker"),
        (["--parts", "tracker", "tracker"], "expected different names"),
        (["--out", "README.md"], "out = 'README.md': expected a folder"),
    ],
)
def test_wrong_options_end_before_anything_is_run(arguments, message, monkeypatch):
    monkeypatch.setattr(bench, "run_part", lambda *_: pytest.fail("run"))
    with pytest.raises(ValueError, match=message):
        bench.main(arguments)
