"""Many free-running episodes, against the exact Jacobian and against the bare stock initiator."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from jaxtrack.params import StaticParams
from jaxtrack.tracker import DEFAULT
from reference.parity.compare import TOLERANCE
from reference.parity.episodes import Comparison, EpisodeTallies, compare_episode
from reference.parity.oracle import Job, run_all
from reference.parity.ours import episode
from reference.parity.rows import Row
from reference.parity.scenarios import Scenario, random_scenario
from reference.pipeline import StepRecord

STOCK_TOLERANCE = 0.1
"""Largest error against the bare stock initiator, whose Jacobian is a finite difference (sigma)."""

SINGLE_TOLERANCE = 0.1
"""Largest error in single precision that is no divergence (sigma)."""

Follow = Callable[[Any, int, str], Iterator[Any]]


def free_running_rows(
    seeds: range, steps: int, processes: int, follow: Follow
) -> tuple[list[Row], list[str]]:
    """Whole random episodes; the rows, and every first divergence in one line.

    Args:
        seeds: numbers of the random scenarios.
        steps: of each episode.
        processes: for Stone Soup.
        follow: shows progress over an iterable of the given length under the given name.
    """
    scenarios = [random_scenario(seed, steps) for seed in seeds]
    double, single, stock = EpisodeTallies(), EpisodeTallies(), EpisodeTallies()
    exact = run_all([Job(scenario) for scenario in scenarios], processes)
    bare = run_all([Job(scenario, exact_jacobian=False) for scenario in scenarios], processes)
    for seed, scenario, records in follow(zip(seeds, scenarios, exact, strict=True), len(seeds), "episodes"):
        double.add(seed, compare(scenario, records, True, TOLERANCE))
        single.add(seed, compare(scenario, records, False, SINGLE_TOLERANCE))
    named = "episodes, stock initiator"
    for seed, scenario, records in follow(zip(seeds, scenarios, bare, strict=True), len(seeds), named):
        stock.add(seed, compare(scenario, records, True, STOCK_TOLERANCE))
    return _rows(len(seeds), double, single, stock), [
        f"episode {seed}{kind}: {divergence}"
        for kind, tally in (("", double), (" (float32)", single), (" (stock initiator)", stock))
        for seed, divergence in tally.divergences
    ]


def compare(
    scenario: Scenario,
    records: list[StepRecord],
    is_double: bool,
    tolerance: float,
    static: StaticParams = DEFAULT,
) -> Comparison:
    """Our episode, in one precision, beside Stone Soup's."""
    active = np.asarray(scenario.detections.active)
    tracks, info = episode(scenario, is_double, static)
    return compare_episode(records, tracks, info, active, scenario.params, tolerance, static)


def _rows(episodes: int, double: EpisodeTallies, single: EpisodeTallies, stock: EpisodeTallies) -> list[Row]:
    return [
        Row(
            "lifecycle.initial_estimate",
            "SimpleMeasurementInitiator, whole episodes",
            double.births,
            "births",
            float64=double.birth.largest,
            float32=single.birth.largest,
            stock=stock.birth.largest,
        ),
        Row(
            "tracker.step",
            f"MultiTargetTracker, {episodes:,} whole episodes",
            double.steps,
            "steps",
            float64=double.state.largest,
            float32=single.state.largest,
            stock=stock.state.largest,
            agreement=double.agreement,
            agreement32=single.agreement,
            agreement_stock=stock.agreement,
            ties=double.ties,
            note=double.note(
                f"exact ties that ended an episode: {double.ties}",
                "decisions of float32 and of the stock initiator are counted up to their first difference",
            ),
        ),
    ]
