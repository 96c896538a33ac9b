"""Plays policies on the same scenarios and compares them: `python -m train.evaluate --run DIR`."""

import csv
import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.stats import bootstrap

from jaxtrack import metrics
from jaxtrack.cli import parse, run, wide_console
from jaxtrack.env import EnvState, SearchTrack
from jaxtrack.params import Params
from jaxtrack.policies import POLICIES, Policy, PolicyBuilder
from jaxtrack.reward import reward_terms
from train.agents import agent_policy
from train.checkpoint import load_run

Results = dict[str, dict[str, np.ndarray]]
"""Policy to metric to one value per episode."""

COMPARED_SEED = 1_000_000
"""Seed of the scenarios on which policies are compared, far from the seeds of training."""

METRICS = {
    "gospa": "GOSPA distance (m)",
    "gospa_localisation": "GOSPA localisation (m^p)",
    "gospa_missed": "GOSPA missed (m^p)",
    "gospa_false": "GOSPA false (m^p)",
    "completeness": "completeness",
    "track_to_target_ratio": "track-to-target ratio",
    "covariance_norm_mean": "mean covariance norm (m²)",
    "uncertainty_per_truth": "uncertainty per truth (m²)",
    "mean_scan_value": "mean scan value",
    "episode_return": "return",
}
"""Metrics of an episode; all but the ratio and the return are means over its steps.

The ratio is the number of tracks ever initiated per truth (Stone Soup's `BasicMetrics`). Steps
without a track count 0 in the mean covariance norm.
"""


def play_episodes(
    keys: jax.Array,
    which: jax.Array,
    policies: Sequence[Policy],
    env: SearchTrack,
    params: Params,
    length: int,
) -> dict[str, jax.Array]:
    """Plays policy number `which` on the scenarios of `keys` `[E]`; metrics `[E]`.

    The scenario (truths and all noise) follows from the key alone, so that every policy meets
    the same ones.
    """

    def episode(key: jax.Array) -> dict[str, jax.Array]:
        key_reset, key_noise, key_policy = jax.random.split(key, 3)
        _, start = env.reset_env(key_reset, params)

        def one_step(state: EnvState, key: jax.Array) -> tuple[EnvState, dict[str, jax.Array]]:
            action = jax.lax.switch(which, policies, key_policy, state)
            after, _ = env.advance(state, action, env.sample_noise(key), params)
            return after, step_metrics(state, after, env, params)

        steps = jax.random.split(key_noise, length)
        end, values = jax.lax.scan(one_step, start, steps)
        result = {name: value.mean() for name, value in values.items() if name != "reward"}
        result["episode_return"] = values["reward"].sum()
        result["track_to_target_ratio"] = end.num_initiated / env.static.num_truths
        return result

    return jax.vmap(episode)(keys)


def step_metrics(before: EnvState, after: EnvState, env: SearchTrack, params: Params) -> dict[str, jax.Array]:
    """Every metric of one step."""
    truths, tracks = after.truths, after.tracks
    gospa = metrics.gospa(truths, tracks, params)
    reward = reward_terms(before.tracks, tracks, after.truths, after.scan_map, env.static, params)
    return {
        "gospa": gospa.distance,
        "gospa_localisation": gospa.localisation,
        "gospa_missed": gospa.missed,
        "gospa_false": gospa.false,
        "completeness": metrics.completeness(truths, tracks, params),
        "covariance_norm_mean": metrics.covariance_norm_mean(tracks),
        "uncertainty_per_truth": metrics.uncertainty_per_truth(truths, tracks, params),
        "mean_scan_value": jnp.mean(after.scan_map),
        "reward": reward[0] + reward[1],
    }


def compare(
    policies: Mapping[str, PolicyBuilder],
    env: SearchTrack,
    params: Params,
    episodes: int,
    seed: int,
    advance: Callable[[], None] = lambda: None,
) -> Results:
    """Plays every policy on the same scenarios; compiles once for all of them.

    Args:
        policies: policies by the name they get in the table.
        env: the environment.
        params: its numbers.
        episodes: number of scenarios.
        seed: of the scenarios.
        advance: called after each policy.
    """
    keys = jax.random.split(jax.random.key(seed), episodes)

    @jax.jit
    def play(keys: jax.Array, which: jax.Array, params: Params) -> dict[str, jax.Array]:
        built = [build(env.static, params) for build in policies.values()]
        return play_episodes(keys, which, built, env, params, length)

    length = int(params.max_steps_in_episode)
    results: Results = {}
    for which, name in enumerate(policies):
        played = jax.device_get(play(keys, jnp.asarray(which), params))
        results[name] = {metric: np.asarray(played[metric], dtype=float) for metric in METRICS}
        advance()
    return results


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean and its 95 % bootstrap interval (percentiles of 2,000 resamples)."""
    if len(values) < 2 or np.ptp(values) == 0:
        return (float(np.mean(values)),) * 3
    resampled = bootstrap((values,), np.mean, n_resamples=2000, method="percentile", rng=0)
    low, high = resampled.confidence_interval
    return float(np.mean(values)), float(low), float(high)


def summarise(results: Results) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Policy to metric to (mean, low, high)."""
    return {
        policy: {metric: interval(values) for metric, values in by_metric.items()}
        for policy, by_metric in results.items()
    }


def paired_difference(
    results: Results, policy: str, metric: str = "gospa"
) -> dict[str, tuple[float, float, float]]:
    """Mean and interval of `policy` minus each other policy, scenario by scenario."""
    own = results[policy][metric]
    return {other: interval(own - values[metric]) for other, values in results.items() if other != policy}


def write_results(results: Results, folder: Path) -> None:
    """Writes results.json (means and intervals) and episodes.csv (every episode)."""
    summary = {
        policy: {
            metric: dict(zip(("mean", "low", "high"), triple, strict=True)) for metric, triple in row.items()
        }
        for policy, row in summarise(results).items()
    }
    (folder / "results.json").write_text(json.dumps(summary, indent=2) + "\n")
    with open(folder / "episodes.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["policy", "episode", *METRICS])
        for policy, by_metric in results.items():
            for episode, row in enumerate(zip(*(by_metric[metric] for metric in METRICS), strict=True)):
                writer.writerow([policy, episode, *row])


def print_results(results: Results, agent: str | None, console: Console) -> None:
    """Prints the table, and how the agent's GOSPA differs from the others'."""
    summary = summarise(results)
    episodes = len(next(iter(results.values()))["gospa"])
    table = Table(title=f"{episodes} scenarios, mean and half width of the 95 % interval")
    table.add_column("metric")
    for policy in summary:
        table.add_column(policy, justify="right", style="bold" if policy == agent else None)
    for metric, label in METRICS.items():
        cells = [_cell(summary[policy][metric]) for policy in summary]
        table.add_row(label, *cells)
    console.print(table)
    for other, (mean, low, high) in paired_difference(results, agent).items() if agent else ():
        console.print(
            f"GOSPA of {agent} minus {other}: {mean:+.1f} m, 95 % interval [{low:+.1f}, {high:+.1f}]"
        )


def _cell(triple: tuple[float, float, float]) -> str:
    mean, low, high = triple
    digits = 3 if abs(mean) < 10 else 1 if abs(mean) < 1000 else 0
    return f"{mean:.{digits}f} ±{(high - low) / 2:.{digits}f}"


def compare_with_baselines(
    name: str,
    policy: PolicyBuilder,
    env: SearchTrack,
    params: Params,
    episodes: int,
    seed: int,
    console: Console,
) -> Results:
    """Compares one policy with all baselines, with a progress bar where there is a terminal."""
    policies = {name: policy, **POLICIES}
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("evaluating", total=len(policies))
        return compare(policies, env, params, episodes, seed, lambda: progress.advance(task))


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Compares a trained run with all baselines on the same scenarios."""

    run: Path = Path("runs/main")
    """Folder of the run."""
    episodes: int = 100
    """Number of scenarios."""
    seed: int = COMPARED_SEED
    """Seed of the scenarios."""
    greedy: bool = False
    """Take the most probable look instead of sampling."""
    out: Path | None = None
    """Folder for results.json and episodes.csv; nothing is written without it."""


def main(argv: Sequence[str]) -> int:
    """The command."""
    options = parse(EvaluateOptions(), argv, "python -m train.evaluate")
    if options.episodes < 1:
        raise ValueError(f"episodes = {options.episodes}: expected an integer >= 1")
    if options.seed < 0:
        raise ValueError(f"seed = {options.seed}: expected an integer >= 0")
    config, env, weights = load_run(options.run)
    policy = agent_policy(config.encoder, weights, options.greedy)
    console = wide_console()
    results = compare_with_baselines(
        config.encoder, policy, env, config.params, options.episodes, options.seed, console
    )
    print_results(results, config.encoder, console)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_results(results, options.out)
    return 0


if __name__ == "__main__":
    run(main)
