"""Options that are tables of numbers by name: pairs NAME=... on the command line, tables in TOML and JSON."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tyro.constructors import PrimitiveConstructorSpec


def table_option(
    form: str, example: str, read: Callable[[str], Any], write: Callable[[Any], str]
) -> PrimitiveConstructorSpec:
    """How the command line reads such an option, whatever its value was before.

    Args:
        form: of one word, such as NAME=FROM:TO.
        example: such a word.
        read: what follows the name, to its value; raises ValueError if it is none.
        write: the inverse of `read`.
    """

    def read_all(words: Sequence[str]) -> dict[str, Any]:
        table = {}
        for word in words:
            name, _, value = word.partition("=")
            try:
                table[name.replace("-", "_")] = read(value)
            except ValueError:
                raise ValueError(f"{word!r}: expected {form}, such as {example}") from None
        return table

    def write_all(table: Mapping[str, Any]) -> list[str]:
        return [f"{name}={write(value)}" for name, value in table.items()]

    return PrimitiveConstructorSpec("*", form, read_all, lambda value: isinstance(value, dict), write_all)


def read_number(text: str) -> float:
    """A number, whole if it is written so; raises ValueError if it is none."""
    try:
        return int(text)
    except ValueError:
        return float(text)
