"""The datasheet's table of scenarios: how it is made, and that it has them all."""

import re
from pathlib import Path

import pytest

from jaxtrack.scenarios import SCENARIOS
from tests.train.test_evaluate import TINY
from train import scenario_table
from train.scenario_table import BEGIN, END

DATASHEET = Path(__file__).parents[2] / "jaxtrack/README.md"

pytestmark = pytest.mark.usefixtures("quick_compilation")


def test_the_command_replaces_the_table_of_a_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    options = ["--scenarios", "tiny.toml", "--policies", "random", "--episodes", "3", "--page", "page.md"]
    assert scenario_table.main(options) == 0
    text = page.read_text()
    assert text.startswith(f"before\n{BEGIN}\n| scenario | what differs from `paper` | random |\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    assert re.search(
        r"^\| `tiny.toml` \| `num_truths` 2, .*`beam_azimuth` 0.9 rad \| [\d.]+ ± [\d.]+ \|$", text, re.M
    )
    assert "mean over 3 episodes" in text
    said = capsys.readouterr()
    assert said.out in text.partition(BEGIN)[2]
    assert re.fullmatch(r"1/1 tiny.toml: \d+\.\d min\n", said.err)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "0"], "episodes = 0: expected an integer in "),
        (["--policies", "best"], "policies = 'best': expected some of random, static"),
        (["--scenarios", "moon"], "scenario = 'moon': expected paper, clutter"),
        (["--page", "nowhere/page.md"], "page = 'nowhere/page.md': expected a file in a folder that exists"),
        (["--page", "bare.md"], "page = 'bare.md': expected the marks <!-- scenarios: begin --> and "),
    ],
)
def test_bad_options_are_refused_before_anything_is_played(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.md").write_text("no table")
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        scenario_table.main(options)


def test_the_datasheet_has_a_line_with_baselines_for_every_scenario():
    _, _, rest = DATASHEET.read_text().partition(BEGIN)
    table = rest.partition(END)[0]
    columns = len(scenario_table.Options().policies)
    line = rf"^\| `(\w+)` \| ([^|]*?) \|(?: [\d.]+ ± [\d.]+ \|){{{columns}}}$"
    rows = re.findall(line, table, re.MULTILINE)
    written = {name: scenario_table.in_words(fields) for name, fields in SCENARIOS.items()}
    assert dict(rows) == written
