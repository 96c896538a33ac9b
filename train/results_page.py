"""The page of results in Markdown: the paper's table beside ours, what it leaves open, and our figures."""

import itertools
import os
from collections.abc import Mapping
from pathlib import Path

from jaxtrack.params import Params, StaticParams
from jaxtrack.report import circumstances, markdown_table
from train import statistics
from train.episode_metrics import METRICS, NEES_BAND
from train.episodes import Comparison, Played
from train.figures import FIGURES
from train.paper import PAPER, SOURCE, open_places
from train.results import Estimates, Summary, format_estimate, format_number, num_episodes

BASELINES = ("random", "coverage", "static")
"""The paper's policies that are not trained, whose order is compared."""
T2T_READINGS = ("track_to_target_ratio", "mean_track_to_target_ratio")
NORM_READINGS = ("covariance_norm_when_tracking", "covariance_norm_mean")
CAUTION = (
    "Its ± is not explained there and is far wider than an interval of a mean of 100 simulations; ours is "
    "such an interval. The two are not measured on the same scenario, because the paper leaves much of its "
    "scenario open (see below): orders can be compared, sizes can not."
)
NOTHING = "–"  # noqa: RUF001


def render(
    comparison: Comparison,
    summary: Summary,
    static: StaticParams,
    params: Params,
    seed: int,
    command: str,
    figures: Mapping[str, Path],
    folder: Path,
) -> str:
    """The whole page.

    Args:
        comparison: what was played.
        summary: its estimates.
        static: shapes of the scenario.
        params: numbers of the scenario.
        seed: of the scenarios.
        command: what the page is made with.
        figures: pictures by name.
        folder: where the page will lie, from which the pictures are linked.
    """
    number = num_episodes(comparison.played)
    episode = f"{int(params.max_steps_in_episode)} steps of {1000 * float(params.time_step):g} ms"
    parts = [
        "# Results",
        f"{number} scenarios of {episode}, the same for all policies; mean ± half of the 95 % interval. "
        "This page is generated; what every number means is defined in `train/README.md`.",
        "## The paper's table beside ours",
        paper_table(summary.mean),
        f"The paper's columns are its authors' results: {SOURCE}. {CAUTION}",
        "\n".join(orders(comparison.played, summary.mean)),
        "## All metrics",
        metric_table(summary.mean),
        "The same as interquartile means, the mean of the middle half of the episodes:",
        metric_table(summary.interquartile_mean),
        "A consistent filter has NEES / 6 = 1, and 0.95 of its NEES "
        f"between {NEES_BAND[0]:.2f} and {NEES_BAND[1]:.2f}.",
        "## Figures",
        *(figure_of(name, path, folder) for name, path in figures.items()),
        "## What the paper leaves open, and what we chose",
        markdown_table(["what", "paper", "here"], open_places(static, params)),
        "## How this was made",
        made_with(comparison, number, seed, command),
    ]
    return "\n\n".join(parts) + "\n"


def paper_table(means: Estimates) -> str:
    """The paper's rows and ours side by side."""
    rows = []
    known = {row.ours: row for row in PAPER}
    names = [*known, *(name for name in means if name not in known)]
    for name in names:
        row = known.get(name)
        theirs = [row.name, f"{row.t2t:.3f}", row.norm_as_printed] if row else [NOTHING] * 3
        own = means.get(name)
        ours = [
            format_estimate(own[reading]) if own else NOTHING for reading in (*T2T_READINGS, *NORM_READINGS)
        ]
        rows.append([theirs[0], name if own else NOTHING, theirs[1], *ours[:2], theirs[2], *ours[2:]])
    header = [
        "paper's policy",
        "our policy",
        "paper: mean T2T",
        *(f"ours: {METRICS[one]}" for one in T2T_READINGS),
    ]
    header += ["paper: mean covariance norm", *(f"ours: {METRICS[one]}" for one in NORM_READINGS)]
    return markdown_table(header, rows)


def orders(played: Mapping[str, Played], means: Estimates) -> list[str]:
    """What is said of the order of the baselines, by every reading of the paper's two columns."""
    return [
        *(order_of(played, means, reading, "t2t") for reading in T2T_READINGS),
        *(order_of(played, means, reading, "norm") for reading in NORM_READINGS),
    ]


def order_of(played: Mapping[str, Played], means: Estimates, reading: str, column: str) -> str:
    """Whether our random, coverage and static stand in the paper's order, by one reading of its column."""
    missing = [name for name in BASELINES if name not in played]
    title = {"t2t": "mean T2T", "norm": "mean covariance norm"}[column]
    if missing:
        return f"* {METRICS[reading]}: no order to compare, {', '.join(missing)} not played."
    theirs = {row.ours: float(getattr(row, column)) for row in PAPER if row.ours in BASELINES}
    ours = {name: means[name][reading].value for name in BASELINES}
    order, paper_order = (sorted(values, key=values.__getitem__, reverse=True) for values in (ours, theirs))
    written = " > ".join(f"{name} {format_number(ours[name])}" for name in order)
    verdict = "the paper's order" if order == paper_order else f"not the paper's, {' > '.join(paper_order)}"
    sure = all(_differ(played, a, b, reading) for a, b in itertools.pairwise(order))
    certainty = "each above the next with 95 % confidence" if sure else "not every step of it beyond chance"
    return f"* Order by {METRICS[reading]}, as the paper's {title}: {written} ({certainty}); {verdict}."


def _differ(played: Mapping[str, Played], a: str, b: str, reading: str) -> bool:
    """Whether the interval of a minus b lies above zero."""
    first, second = played[a].values[reading], played[b].values[reading]
    return statistics.difference(first, second, statistics.resample(first.shape[1])).low > 0


def metric_table(estimates: Estimates) -> str:
    """A row per metric, a column per policy."""
    rows = [
        [label, *(format_estimate(own[metric]) for own in estimates.values())]
        for metric, label in METRICS.items()
    ]
    return markdown_table(["metric", *estimates], rows)


def figure_of(name: str, path: Path, folder: Path) -> str:
    """A picture with its caption, linked from the page's folder."""
    link = Path(os.path.relpath(path, folder)).as_posix()
    return f"![{name}]({link})\n\n*{FIGURES[name]}*"


def made_with(comparison: Comparison, episodes: int, seed: int, command: str) -> str:
    """Command, seeds, time, versions and machine."""
    found = circumstances()
    machine, versions = found["machine"], found["versions"]
    trained = {name: one.seeds for name, one in comparison.played.items() if one.seeds}
    seeds = (
        "; ".join(f"{name} {', '.join(map(str, own))}" for name, own in trained.items())
        or "no trained policy"
    )
    lines = [
        f"* seed of the scenarios {seed}; training seeds: {seeds}",
        f"* compiled in {comparison.compile_seconds:.1f} s, {episodes} episodes of each of "
        f"{len(comparison.played)} policies in {comparison.play_seconds:.1f} s",
        f"* {found['date']}; {', '.join(f'{name} {number}' for name, number in versions.items())}",
        f"* {machine['cores']} cores of {machine['processor']}, {machine['system']}, "
        f"JAX on {machine['jax_backend']}",
    ]
    return f"```\n{command}\n```\n\n" + "\n".join(lines)
