"""The parity table, in the terminal and in the README."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from jaxtrack.report import markdown_table
from reference.parity.rows import Row

BEGIN, END = "<!-- parity: begin -->", "<!-- parity: end -->"

HEADER = (
    "jaxtrack",
    "Stone Soup",
    "compared",
    "float64",
    "float32",
    "stock initiator",
    "decisions: float64 / float32 / stock",
)


def cells(row: Row) -> list[str]:
    """One line of the table."""
    ties = f", {row.ties} exact ties left out" if row.ties else ""
    decisions = [row.agreement, row.agreement32, row.agreement_stock]
    while decisions and decisions[-1] is None:
        decisions.pop()
    return [
        row.component,
        row.stone_soup,
        f"{row.compared:,} {row.unit}{ties}",
        *(_error(value) for value in (row.float64, row.float32, row.stock)),
        " / ".join(_share(value) for value in decisions),
    ]


def _error(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _share(value: float | None) -> str:
    if value is None:
        return "-"
    # Rounding must not make all of nearly all.
    return "100 %" if value == 1 else f"{min(100 * value, 99.9999):.4f} %"


def print_rows(rows: list[Row], console: Console) -> None:
    """Prints the table, what failed in red."""
    table = Table(*HEADER)
    for row in rows:
        table.add_row(*cells(row), style="" if row.passed else "red")
    console.print(table)


def write_readme(path: Path, rows: list[Row], below: str) -> None:
    """Replaces what is between the two marks.

    Raises:
        ValueError: naming the file, if it has not both marks.
    """
    text = path.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"readme = {str(path)!r}: expected the marks {BEGIN} and {END}")
    table = markdown_table(HEADER, [[f"`{row.component}`", *cells(row)[1:]] for row in rows])
    notes = [f"* `{row.component}` ({row.stone_soup}): {row.note}." for row in rows if row.note]
    body = "\n\n".join(part for part in (table, "\n".join(notes), below) if part)
    path.write_text(f"{before}{BEGIN}\n{body}\n{END}{after}")
