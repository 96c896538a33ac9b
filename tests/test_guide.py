"""The pages of the guide: their blocks run as they stand, from top to bottom, in one folder."""

import importlib
import itertools
import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs/guide"
PAGES = sorted(GUIDE.glob("*.md"))
BLOCK = re.compile(r"```([^\n]*)\n(.*?)```", re.DOTALL)
LANGUAGES = {"python", "python sb3", "sh"}
LONG = ("change_the_scenario", "evaluate", "train", "write_a_policy")
"""Pages that run with -m medium."""


def blocks(page):
    """Language and text of every block of a page."""
    return BLOCK.findall(page.read_text())


def run_commands(text):
    """Lines ``python -m MODULE ARGUMENTS``, in this process."""
    for line in text.splitlines():
        python, flag, module, *arguments = shlex.split(line, comments=True)
        assert (python, flag) == ("python", "-m")
        assert importlib.import_module(module).main(arguments) == 0, line


def run_page(page, capsys):
    """Runs all blocks of a page, of which each prints something, but those that write a file."""
    names = {"__name__": "__main__"}
    for language, text in blocks(page):
        if language == "sh":
            run_commands(text)
        else:
            exec(compile(text, page.name, "exec"), names)
    assert capsys.readouterr().out.strip()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder that has the shipped agents, like the root of the repository."""
    (tmp_path / "agents").symlink_to(ROOT / "agents")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[pytest.mark.medium] if page.stem in LONG else [])
        for page in PAGES
        if "sb3" not in page.name
    ],
)
def test_a_page_runs(page, folder, capsys, quick_compilation):
    run_page(page, capsys)


@pytest.mark.sb3
def test_the_page_of_stable_baselines3_runs(folder, capsys, quick_compilation):
    run_page(GUIDE / "use_it_from_sb3.md", capsys)


def test_every_block_is_run_and_every_page_is_in_the_index():
    assert {language for page in PAGES for language, _ in blocks(page)} == LANGUAGES
    for page in PAGES:
        assert blocks(page), page
    listed = re.findall(r"^guide/(\w+)$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    assert sorted(listed) == [page.stem for page in PAGES]
    for page, following in itertools.pairwise(listed):
        assert f"({following}.md)" in (GUIDE / f"{page}.md").read_text(), f"{page}: leads on to {following}"
