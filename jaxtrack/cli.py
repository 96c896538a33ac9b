"""What all commands share: options from a dataclass, errors in one line with exit code 2."""

import contextlib
import io
import json
import math
import re
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

Options = TypeVar("Options")

BAD_USAGE = 2
INTERRUPTED = 130
LARGEST_SEED = 2**32 - 1
"""JAX takes larger ones too, and forgets what lies beyond 32 bits."""
WIDTH = 150


def parse(default: Options, argv: Sequence[str], prog: str, description: str | None = None) -> Options:
    """Options from the command line, by tyro; `--help` explains every field.

    Args:
        default: dataclass instance with the defaults; its class has a docstring under each field.
        argv: arguments without the program's name.
        prog: the program's name, for the help.
        description: what the command does, if not the class's docstring.

    Raises:
        ValueError: one line, for what tyro says in a box.
        SystemExit: with code 0, after `--help`.
    """
    import tyro

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                type(default), prog=prog, description=description, args=list(argv), default=default
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(_one_line(said.getvalue())) from None


def take_config(argv: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Takes `--config FILE` out of the arguments and reads the file (TOML or JSON).

    Returns:
        The file's fields, empty without the option, and the other arguments.

    Raises:
        ValueError: naming the file, when it can not be read.
    """
    rest = list(argv)
    for place, word in enumerate(rest):
        if word == "--config" and place + 1 < len(rest):
            return read_config(Path(rest[place + 1])), rest[:place] + rest[place + 2 :]
        if word.startswith("--config="):
            return read_config(Path(word.partition("=")[2])), rest[:place] + rest[place + 1 :]
        if word == "--config":
            raise ValueError("config: expected the name of a .toml or .json file after --config")
    return {}, rest


def read_config(path: Path) -> dict[str, Any]:
    """Fields of a configuration file.

    Raises:
        ValueError: naming the file and what is wrong with it.
    """
    if path.suffix not in (".toml", ".json"):
        raise ValueError(f"config = {str(path)!r}: expected a .toml or .json file")
    try:
        text = path.read_text(encoding="utf-8-sig")
        values = tomllib.loads(text) if path.suffix == ".toml" else _read_json(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"config = {str(path)!r}: {error}") from None
    if not isinstance(values, dict):
        raise ValueError(f"config = {str(path)!r}: expected a table of fields")
    return values


def _read_json(text: str) -> Any:
    """The values; like TOML it refuses a field that is given twice, of which Python takes the last."""

    def table(fields: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in fields]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"{twice} is given twice")
        return dict(fields)

    return json.loads(text, object_pairs_hook=table)


def require_integer(name: str, value: int, low: int, high: int | None = None) -> None:
    """Raises ValueError, naming the option, if its value is below `low` or above `high`."""
    if value < low or (high is not None and value > high):
        allowed = f">= {low}" if high is None else f"in [{low}, {high}]"
        raise ValueError(f"{name} = {value}: expected an integer {allowed}")


def require_positive(name: str, value: float) -> None:
    """Raises ValueError, naming the option, if its value is not a finite number above zero."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} = {value}: expected a number > 0")


def require_file(name: str, path: Path) -> None:
    """Raises ValueError, naming the option, if no file can be written at its path."""
    if "\0" in str(path) or path.is_dir() or not path.parent.is_dir():
        raise ValueError(f"{name} = {str(path)!r}: expected a file in a folder that exists")


def wide_console() -> "Console":
    """Console for tables: the terminal's width, or 150 columns in a file or a log."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else WIDTH)


def run(command: Callable[[Sequence[str]], int]) -> None:
    """Runs a command on the program's arguments and exits with its code.

    Wrong input (ValueError, OSError) ends in one line on standard error and exit code 2.
    """
    try:
        code = command(sys.argv[1:])
    except (ValueError, OSError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        code = BAD_USAGE
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)


def _one_line(box: str) -> str:
    """The words of tyro's error box, without its title, its frame and its pointer to --help."""
    words = re.sub(r"\x1b\[[0-9;]*m", "", box)
    words = "\n".join(line for line in words.splitlines() if not line.startswith("╭"))
    words = re.sub(r"[─━┃┏┓┗┛│╭╮╰╯]|-{3,}", " ", words)
    words = re.sub(r"For full helptext.*", "", " ".join(words.split()))
    return words.strip()
