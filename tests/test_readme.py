"""The python blocks of the README files run as they stand."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "jaxtrack/README.md", "docs/stone_soup.md")
BLOCKS = [
    (page, number, block)
    for page in PAGES
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL))
]


@pytest.mark.parametrize(
    ("page", "block"),
    [pytest.param(page, block, id=f"{page}-{number}") for page, number, block in BLOCKS],
)
def test_block_runs_and_prints(page, block, capsys, request):
    if page != PAGES[0]:  # those of the first page are compiled as for a reader
        request.getfixturevalue("quick_compilation")
    exec(compile(block, page, "exec"), {"__name__": "__main__"})
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    assert capsys.readouterr().out.strip()


def test_every_page_has_a_block():
    assert {page for page, _, _ in BLOCKS} == set(PAGES)
