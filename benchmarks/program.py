"""What the compiled step consists of, in operations and kernels: `python -m benchmarks.program`.

Counts, unlike times, are the same on a busy machine: `tests/test_step_program.py` holds them
against upper bounds.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.stages import Compiled, Lowered

from jaxtrack.cli import parse, require_file, require_integer, run, wide_console
from jaxtrack.env import make
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, print_table

ARITHMETIC = ("add", "subtract", "multiply", "divide", "sqrt", "sine", "cosine", "exponential", "select")
KERNELS = ("fusion", "call", "while", "conditional", "custom-call", "reduce", "sort", "scatter", "dot")
ONE_KERNEL = 'xla_cpu_small_call="true"'
STAGE = 'inlineable = "false"'


@dataclasses.dataclass(frozen=True)
class ProgramOptions:
    """Compiles the environment's step and counts what it consists of; nothing is timed."""

    num_envs: int = 64
    """Environments stepped together."""
    out: Path | None = None
    """JSON file for the counts; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""


@dataclasses.dataclass(frozen=True)
class Counts:
    """What a compiled program consists of; loops count once, whatever their number of turns.

    Attributes:
        operations: arithmetic operations on single numbers, by XLA's cost analysis.
        transcendentals: sines, roots and the like, by the same.
        kilobytes: read and written by all kernels, by the same.
        arithmetic: instructions of arithmetic in the optimised program, whatever their length.
        kernels: what the program starts one after the other: fusions, calls, loops, branches.
        loops: loops among these, one kernel start or more for each turn.
        marked: those that hold a whole loop in one piece of machine code (`jaxtrack.kernel`).
        stages: calls that are kept from being inlined, before optimisation; `marked` among them.
    """

    operations: int
    transcendentals: int
    kilobytes: int
    arithmetic: int
    kernels: int
    loops: int
    marked: int
    stages: int


def count(lowered: Lowered) -> Counts:
    """Compiles a program and counts."""
    compiled = lowered.compile()
    text = compiled.as_text() or ""
    entry = text[text.index("\nENTRY") :]
    cost = cost_of(compiled)
    return Counts(
        operations=round(cost["flops"]),
        transcendentals=round(cost.get("transcendentals", 0)),
        kilobytes=round(cost["bytes accessed"] / 1000),
        arithmetic=instructions(text, ARITHMETIC),
        kernels=instructions(entry, KERNELS),
        loops=instructions(entry, ("while",)),
        marked=sum(ONE_KERNEL in line for line in entry.splitlines() if " call(" in line),
        stages=lowered.as_text().count(STAGE),
    )


def cost_of(compiled: Compiled) -> dict[str, float]:
    """XLA's cost analysis.

    Raises:
        ValueError: where the backend has none.
    """
    cost = compiled.cost_analysis()
    if not cost or "flops" not in cost:
        raise ValueError(f"backend = {jax.default_backend()}: it has no cost analysis")
    return cost


def instructions(text: str, names: Sequence[str]) -> int:
    """How many instructions of these names a text in HLO holds."""
    return len(re.findall(rf"^ *(?:ROOT )?%?\S+ = .*?[\]}})] (?:{'|'.join(names)})\(", text, re.MULTILINE))


def together(num_envs: int, static: StaticParams, params: Params) -> Lowered:
    """`env.step` of `num_envs` environments: everything, new episodes included."""
    env, params = make(params, static)
    keys = jax.random.split(jax.random.key(0), num_envs)
    states = jax.eval_shape(jax.vmap(env.reset_env, in_axes=(0, None)), keys, params)[1]
    actions = jnp.zeros((num_envs, 2), dtype=int)
    return jax.jit(jax.vmap(env.step, in_axes=(0, 0, 0, None))).lower(keys, states, actions, params)


def alone(static: StaticParams, params: Params) -> Lowered:
    """`env.play` of one environment: what the kernel does at every turn of its loop, and the scan map."""
    env, params = make(params, static)
    key = jax.random.key(0)
    state = jax.eval_shape(env.reset_env, key, params)[1]
    return jax.jit(env.play).lower(key, state, jnp.zeros(2, dtype=int), params)


HEADER = ("program", *(field.name for field in dataclasses.fields(Counts)))


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    options = parse(ProgramOptions(), argv, "python -m benchmarks.program")
    require_integer("num_envs", options.num_envs, 2)
    if options.out is not None:
        require_file("out", options.out)
    static, params = StaticParams(), Params()
    programs: dict[str, Callable[[], Lowered]] = {
        f"step of {options.num_envs}": lambda: together(options.num_envs, static, params),
        "play of 1": lambda: alone(static, params),
    }
    counts = {name: count(build()) for name, build in programs.items()}
    rows = [[name, *(f"{value:,}" for value in vars(found).values())] for name, found in counts.items()]
    report: dict[str, Any] = circumstances()
    title = f"jax {report['versions']['jax']}, {report['machine']['jax_backend']}"
    print_table(HEADER, rows, title, options.markdown, wide_console())
    if options.out is not None:
        report["counts"] = {name: vars(found) for name, found in counts.items()}
        options.out.write_text(json.dumps(report, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    run(main)
