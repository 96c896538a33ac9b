"""What a comparison says: estimates with intervals, the table on the terminal, and the files."""

import csv
import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrack.env import SearchTrack
from jaxtrack.params import Params
from jaxtrack.report import circumstances
from train import statistics
from train.episode_metrics import CURVES, METRICS
from train.episodes import Comparison, Played
from train.sealed import write_whole
from train.statistics import Estimate

RANKED = {"gospa": True, "completeness": False, "uncertainty_per_truth": True}
"""Metrics by which policies are ranked, and whether less is better."""

Estimates = dict[str, dict[str, Estimate]]


@dataclasses.dataclass(frozen=True)
class Summary:
    """Estimates with their intervals.

    Attributes:
        mean: policy to metric.
        interquartile_mean: policy to metric.
        differences: of two policies, the first minus the second, scenario by scenario, by metric.
        improvement: metric to policy to other policy: probability that the one beats the other.
    """

    mean: Estimates
    interquartile_mean: Estimates
    differences: dict[tuple[str, str], dict[str, Estimate]]
    improvement: dict[str, Estimates]


def summarise(played: Mapping[str, Played]) -> Summary:
    """All estimates of a comparison."""
    values = {name: one.values for name, one in played.items()}
    drawn = statistics.resample(num_episodes(played))
    differences = {
        (a, b): {
            metric: statistics.difference(values[a][metric], values[b][metric], drawn) for metric in METRICS
        }
        for a in values
        for b in values
        if a != b
    }
    improvement = {
        metric: {
            a: {
                b: statistics.probability_of_improvement(values[a][metric], values[b][metric], less, drawn)
                for b in values
                if a != b
            }
            for a in values
        }
        for metric, less in RANKED.items()
    }
    return Summary(
        mean={name: _each(statistics.mean, own, drawn) for name, own in values.items()},
        interquartile_mean={
            name: _each(statistics.interquartile_mean, own, drawn) for name, own in values.items()
        },
        differences=differences,
        improvement=improvement,
    )


def num_episodes(played: Mapping[str, Played]) -> int:
    """Number of scenarios that were played."""
    return next(iter(played.values())).values["gospa"].shape[1]


def _each(statistic: Any, values: Mapping[str, np.ndarray], drawn: np.ndarray) -> dict[str, Estimate]:
    return {metric: statistic(values[metric], drawn) for metric in METRICS}


def write_results(
    comparison: Comparison, summary: Summary, env: SearchTrack, params: Params, seed: int, folder: Path
) -> None:
    """Writes results.json, episodes.csv and curves.npz (see `train/README.md`)."""
    document = {
        **circumstances(),
        "seed": seed,
        "episodes": num_episodes(comparison.played),
        "seconds": {"compiling": comparison.compile_seconds, "playing": comparison.play_seconds},
        "scenario": {"static": vars(env.static), "params": _numbers(params)},
        "policies": {name: _policy(name, one, summary) for name, one in comparison.played.items()},
        "differences": _nested(summary.differences),
        "probability_of_improvement": summary.improvement,
    }
    _write_episodes(comparison.played, folder / "episodes.csv")
    _write_curves(comparison.played, params, folder / "curves.npz")
    # The last one: it tells a resumed training that nothing is left to do.
    text = json.dumps(_plain(document), indent=1, allow_nan=False) + "\n"
    write_whole(folder / "results.json", text.encode())


def _numbers(params: Params) -> dict[str, Any]:
    """The numbers, without recorded trajectories, which may be long."""
    values = {name: value for name, value in vars(params).items() if name != "trajectories"}
    return {**values, "trajectories": None if params.trajectories is None else "recorded"}


def _policy(name: str, played: Played, summary: Summary) -> dict[str, Any]:
    by_seed = {metric: statistics.seed_means(values) for metric, values in played.values.items()}
    return {
        "training_seeds": played.seeds,
        "metrics": {
            metric: {
                "mean": summary.mean[name][metric],
                "interquartile_mean": summary.interquartile_mean[name][metric],
                "by_training_seed": by_seed[metric],
            }
            for metric in METRICS
        },
    }


def _nested(pairs: Mapping[tuple[str, str], Any]) -> dict[str, dict[str, Any]]:
    nested: dict[str, dict[str, Any]] = {}
    for (a, b), value in pairs.items():
        nested.setdefault(a, {})[b] = value
    return nested


def _plain(value: Any) -> Any:
    """The same for JSON: estimates by name, null for what is not a number."""
    if isinstance(value, Estimate):
        return {name: _plain(number) for name, number in value._asdict().items()}
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _write_episodes(played: Mapping[str, Played], path: Path) -> None:
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["policy", "training_seed", "episode", *METRICS])
        for name, one in played.items():
            for row, seed in enumerate(one.seeds or ("",)):
                columns = [one.values[metric][row] for metric in METRICS]
                for episode, line in enumerate(zip(*columns, strict=True)):
                    cells = ["" if math.isnan(value) else f"{value:.8g}" for value in line]
                    writer.writerow([name, seed, episode, *cells])


def _write_curves(played: Mapping[str, Played], params: Params, path: Path) -> None:
    curves = [
        [[one.curves[name].mean, one.curves[name].low, one.curves[name].high] for name in CURVES]
        for one in played.values()
    ]
    steps = np.arange(1, np.shape(curves)[-1] + 1)
    np.savez_compressed(
        path,
        policies=np.array(list(played)),
        curves=np.array(list(CURVES)),
        time=params.time_step * steps,
        values=np.array(curves, dtype=np.float32),
        looks=np.stack([one.looks for one in played.values()]),
    )


def print_results(comparison: Comparison, summary: Summary, agents: list[str], console: Console) -> None:
    """Prints the table, how fast it was made, and how the agents' GOSPA differs from the others'."""
    episodes = num_episodes(comparison.played)
    table = Table(title=f"{episodes} scenarios, mean and half width of the 95 % interval")
    table.add_column("metric")
    for name in summary.mean:
        table.add_column(name, justify="right", style="bold" if name in agents else None)
    for metric, label in METRICS.items():
        table.add_row(label, *(format_estimate(row[metric]) for row in summary.mean.values()))
    console.print(table)
    number = sum(one.values["gospa"].size for one in comparison.played.values())
    console.print(
        f"compiled in {comparison.compile_seconds:.1f} s; played {number} episodes in "
        f"{comparison.play_seconds:.1f} s ({number / comparison.play_seconds:.1f} episodes/s)"
    )
    for name, one in comparison.played.items():
        if len(one.seeds) > 1:
            console.print(say_seeds(name, one))
    for (agent, other), by_metric in summary.differences.items():
        if agent in agents:
            value, low, high = by_metric["gospa"]
            console.print(
                f"GOSPA of {agent} minus {other}: {value:+.1f} m, 95 % interval [{low:+.1f}, {high:+.1f}]"
            )


def say_seeds(name: str, played: Played) -> str:
    """How far the trainings of an agent lie apart, of which the intervals over scenarios say nothing."""
    means = statistics.seed_means(played.values["gospa"])
    each = ", ".join(f"{seed}: {mean:.1f}" for seed, mean in zip(played.seeds, means, strict=True))
    return f"GOSPA of {name} by training seed: {each} m; standard deviation {np.std(means, ddof=1):.1f} m"


def format_estimate(estimate: Estimate) -> str:
    """Value and half width of its interval, with as many digits as are worth reading."""
    value, low, high = estimate
    half = "" if math.isnan(low) else f" ± {(high - low) / 2:.{_digits(value)}f}"
    return format_number(value) + half


def format_number(value: float) -> str:
    """A number with as many digits as are worth reading; a dash for none."""
    return "-" if math.isnan(value) else f"{value:.{_digits(value)}f}"


def _digits(value: float) -> int:
    return 3 if abs(value) < 10 else 1 if abs(value) < 1000 else 0
