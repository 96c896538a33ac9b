"""Plays policies on the same scenarios and compares them: `python -m train.evaluate`."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from jaxtrack.cli import LARGEST_SEED, parse, require_integer, run, wide_console
from jaxtrack.env import SearchTrack
from jaxtrack.managers import MANAGERS
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import POLICIES
from train.agents import agent_policy
from train.config import TrainConfig, to_dict
from train.episodes import Comparison, Competitor, compare, rule
from train.results import Summary, print_results, summarise, write_results
from train.saved_run import load_run
from train.scenarios import build_scenario
from train.seeds import run_folders

COMPARED_SEED = 1_000_000
"""Seed of the scenarios on which policies are compared, far from the seeds of training."""

LARGEST_EPISODES = 1_000_000

ALL, PLANNERS = "all", "planners"
IMPORTANT_SHAPES = ("max_tracks", "map_size", "num_looks", "continuous_actions", "observe_variances")
"""Shapes that fix an agent's inputs and outputs."""
UNIMPORTANT = ("seed", "out", "evaluation_episodes", "checkpoint_every")
"""Options of a training in which two runs of the same policy may differ."""


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Compares policies on the same scenarios: baselines, planners, and trained runs."""

    policies: tuple[str, ...] = (ALL,)
    """Names of baselines: random, static, coverage, stalest, scheduler, index, index_tuned, gain,
    sweep, sweep_then_track, or "all";
    and of planners: greedy, rollout, uncertainty, or "planners". No name after the option for none."""
    runs: Annotated[tuple[Path, ...], tyro.conf.arg(aliases=["--run"])] = ()
    """Folders of trained runs, or of several seeds; runs that differ in nothing but their seed are one
    policy."""
    episodes: int = 100
    """Number of scenarios."""
    seed: int = COMPARED_SEED
    """Seed of the scenarios."""
    scenario: str = ""
    """Scenario by name (paper, clutter, births, agile, turning, accelerating, crowd, swarm, slow, flying,
    continuous), or a .toml or .json file with fields of Params and StaticParams, or a .csv file of OpenSky
    state vectors; unset, that of the runs, or the paper's without a run."""
    greedy: bool = False
    """Let agents take their most probable look instead of sampling."""
    out: Path | None = None
    """Folder for tables, curves, figures and the page; nothing is written without it."""
    page: Path | None = None
    """Where to write the page of results; unset, results.md in the folder above."""


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(EvaluateOptions(), argv, "python -m train.evaluate")
    check(options)
    folders = [folder for given in options.runs for folder in run_folders(given)]
    runs = [(folder, *load_run(folder)) for folder in folders]
    env, params = build_scenario(options.scenario, [config for _, config, _, _ in runs])
    for folder, config, _, _ in runs:
        check_shapes(folder, config, env.static)
    agents = group_runs([(folder, config, weights) for folder, config, _, weights in runs], options.greedy)
    competitors = {**agents, **baselines(options.policies)}
    if not competitors:
        raise ValueError("policies: expected at least one name, or a run")
    console = wide_console()
    comparison = play(competitors, env, params, options.episodes, options.seed, console)
    summary = summarise(comparison.played)
    print_results(comparison, summary, list(agents), console)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_results(comparison, summary, env, params, options.seed, options.out)
        page = draw_and_tell(comparison, summary, env, params, options, argv)
        console.print(f"results.json, episodes.csv, curves.npz and figures in {options.out}; page in {page}")
    return 0


def check(options: EvaluateOptions) -> None:
    """Raises ValueError, in one line, for options that make no sense."""
    require_integer("episodes", options.episodes, 1, LARGEST_EPISODES)
    require_integer("seed", options.seed, 0, LARGEST_SEED)
    for name in options.policies:
        if name not in (ALL, PLANNERS, *POLICIES, *MANAGERS):
            known = ", ".join([*POLICIES, *MANAGERS])
            raise ValueError(f"policies = {name!r}: expected {ALL}, {PLANNERS}, or some of {known}")
    if options.page is not None and options.out is None:
        raise ValueError("page: expected a folder for its figures too, --out")
    # Before hours of playing, not after them.
    if options.out is not None and (
        "\0" in str(options.out) or (options.out.exists() and not options.out.is_dir())
    ):
        raise ValueError(f"out = {str(options.out)!r}: expected a folder")
    if options.page is not None and ("\0" in str(options.page) or options.page.is_dir()):
        raise ValueError(f"page = {str(options.page)!r}: expected a file")


def check_shapes(folder: Path, config: TrainConfig, static: StaticParams) -> None:
    """Raises ValueError if the scenario does not have the shapes that a run was trained with."""
    for name in IMPORTANT_SHAPES:
        trained, played = getattr(config.static, name), getattr(static, name)
        if trained != played:
            raise ValueError(
                f"runs = {str(folder)!r}: trained with {name} = {trained}, scenario has {played}"
            )


def baselines(names: Sequence[str]) -> dict[str, Competitor]:
    """Policies that are not trained, each once, by the name that they get in tables.

    A planner is called one there: `greedy` alone could be an agent that takes its most probable look.
    """
    builders, groups = {**POLICIES, **MANAGERS}, {ALL: POLICIES, PLANNERS: MANAGERS}
    wanted = [name for word in names for name in groups.get(word, [word])]
    return {f"{name} planner" if name in MANAGERS else name: rule(builders[name]) for name in wanted}


def group_runs(runs: Sequence[tuple[Path, TrainConfig, Any]], greedy: bool) -> dict[str, Competitor]:
    """Runs that differ in their seed only, as one policy each, named after its encoder.

    Where one encoder has several configurations, the name of the first run's folder is added, and of the
    folders above it as far as they are needed to tell them apart.

    Raises:
        ValueError: if a run is given twice.
    """
    groups: list[tuple[dict[str, Any], list[tuple[Path, TrainConfig, Any]]]] = []
    for one in runs:
        essence = {name: value for name, value in to_dict(one[1]).items() if name not in UNIMPORTANT}
        members = next((members for known, members in groups if known == essence), None)
        if members is None:
            groups.append((essence, [one]))
        elif any(one[1].seed == other.seed for _, other, _ in members):
            raise ValueError(f"runs = {str(one[0])!r}: seed {one[1].seed} of this policy is given twice")
        else:
            members.append(one)
    encoders = [members[0][1].encoder for _, members in groups]
    folders = told_apart([members[0][0] for _, members in groups])
    competitors = {}
    for (_, members), folder in zip(groups, folders, strict=True):
        config = members[0][1]
        name = config.encoder if encoders.count(config.encoder) == 1 else f"{config.encoder} ({folder})"
        seeds = tuple(config.seed for _, config, _ in members)
        competitors[name] = agent(config, [weights for _, _, weights in members], seeds, greedy)
    return competitors


def told_apart(folders: Sequence[Path]) -> list[str]:
    """The ends of different paths, of all as many names as it takes to tell them apart: a/seed0, b/seed0."""
    for length in range(1, max((len(folder.parts) for folder in folders), default=1)):
        names = [str(Path(*folder.parts[-length:])) for folder in folders]
        if len({*names}) == len(names):
            return names
    return [str(folder) for folder in folders]


def agent(
    config: TrainConfig, weights: Sequence[Any], seeds: tuple[int, ...], greedy: bool = False
) -> Competitor:
    """A trained policy, with weights for every training seed."""
    return Competitor(lambda own: agent_policy(config.encoder, own, greedy, config.head), weights, seeds)


def play(
    competitors: Mapping[str, Competitor],
    env: SearchTrack,
    params: Params,
    episodes: int,
    seed: int,
    console: Console,
) -> Comparison:
    """`compare` with a progress bar where there is a terminal."""
    columns = (TextColumn("evaluating"), BarColumn(), MofNCompleteColumn(), Speed(), TimeRemainingColumn())
    total = episodes * sum(len(one.weights) for one in competitors.values())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("evaluating", total=total)
        return compare(
            competitors, env, params, episodes, seed, lambda number: progress.advance(task, number)
        )


class Speed(ProgressColumn):
    """Episodes per second."""

    def render(self, task: Task) -> Text:
        """Compiling counts as no episode yet."""
        return Text(f"{task.speed:.1f} episodes/s left" if task.speed else "compiling")


def compare_with_baselines(
    name: str,
    competitor: Competitor,
    env: SearchTrack,
    params: Params,
    episodes: int,
    seed: int,
    console: Console,
) -> Comparison:
    """Compares one policy with all baselines."""
    return play({name: competitor, **baselines((ALL,))}, env, params, episodes, seed, console)


def draw_and_tell(
    comparison: Comparison,
    summary: Summary,
    env: SearchTrack,
    params: Params,
    options: EvaluateOptions,
    argv: Sequence[str],
) -> Path:
    """Draws the figures into the folder of the results, and writes the page that shows them."""
    from train import figures, results_page

    assert options.out is not None
    drawn = figures.draw_all(comparison.played, summary, params, options.out)
    page = options.page or options.out / "results.md"
    page.parent.mkdir(parents=True, exist_ok=True)
    command = shlex.join(["python", "-m", "train.evaluate", *argv])
    page.write_text(
        results_page.render(
            comparison, summary, env.static, params, options.seed, command, drawn, page.parent
        )
    )
    return page


if __name__ == "__main__":
    run(main)
