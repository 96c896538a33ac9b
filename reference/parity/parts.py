"""The parts that a tracker can be made of beside the default ones: whole episodes with each of them."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxtrack.params import StaticParams
from reference.parity.compare import TOLERANCE
from reference.parity.episodes import EpisodeTallies
from reference.parity.free_running import SINGLE_TOLERANCE, STOCK_TOLERANCE, Follow, compare
from reference.parity.oracle import Job, run_all
from reference.parity.rows import Row
from reference.parity.scenarios import KINDS, Scenario, random_scenario


@dataclasses.dataclass(frozen=True)
class Part:
    """One line of the table.

    Attributes:
        component: ours, as module and function.
        stone_soup: the class it stands for.
        static: the tracker that has it, otherwise the default one.
        kinds: kinds of scenarios in which it is compared.
        is_filter: whether it changes numbers, which are then compared in float32 too.
        uses_jacobian: whether the stock Jacobian, a finite difference, makes it another filter.
        note: what a reader must know.
    """

    component: str
    stone_soup: str
    static: StaticParams
    kinds: tuple[str, ...] = KINDS
    is_filter: bool = False
    uses_jacobian: bool = False
    note: str = ""


PARTS = (
    Part(
        "kalman.predict_detections_extended",
        "ExtendedKalmanUpdater",
        StaticParams(filter="extended"),
        is_filter=True,
        uses_jacobian=True,
    ),
    Part(
        "kalman.predict_detections_cubature",
        "CubatureKalmanUpdater, in extended precision",
        StaticParams(filter="cubature"),
        kinds=("field", "crowded"),
        is_filter=True,
        note="bearings within 0.2 rad of the seam at pi are left out: Stone Soup multiplies them unwrapped",
    ),
    Part(
        "kalman.predict_positions, converted.convert",
        "KalmanUpdater with a LinearGaussian model per detection",
        StaticParams(filter="converted"),
        is_filter=True,
    ),
    Part(
        "square_root with unscented",
        "UnscentedKalmanUpdater, which has no square-root form",
        StaticParams(covariance_form="square_root"),
        is_filter=True,
    ),
    Part(
        "square_root with extended",
        "SqrtKalmanUpdater by QR, SqrtKalmanPredictor",
        StaticParams(filter="extended", covariance_form="square_root"),
        is_filter=True,
        uses_jacobian=True,
    ),
    Part(
        "square_root with cubature",
        "UnscentedKalmanUpdater with alpha = 1, beta = 0, kappa = 0",
        StaticParams(filter="cubature", covariance_form="square_root"),
        is_filter=True,
    ),
    Part(
        "square_root with converted",
        "SqrtKalmanUpdater with a LinearGaussian model per detection",
        StaticParams(filter="converted", covariance_form="square_root"),
        is_filter=True,
    ),
    Part(
        "association.associate_global_nearest_neighbour",
        "GNNWith2DAssignment",
        StaticParams(associator="global_nearest_neighbour"),
        kinds=("crowded",),
    ),
    Part("lifecycle.is_missed_long", "UpdateTimeDeleter", StaticParams(deleters=("update_time",))),
    Part(
        "lifecycle.is_missed_often",
        "UpdateTimeStepsDeleter",
        StaticParams(deleters=("update_time_steps",)),
    ),
    Part(
        "lifecycle.delete_tracks, any",
        "CompositeDeleter",
        StaticParams(deleters=("covariance", "update_time_steps")),
    ),
    Part(
        "lifecycle.delete_tracks, all",
        "CompositeDeleter(intersect=True)",
        StaticParams(deleters=("covariance", "update_time"), intersect_deleters=True),
    ),
    Part(
        "lifecycle.take_over",
        "MultiMeasurementInitiator",
        StaticParams(initiator="multi_measurement", min_points=3, deleters=("update_time_steps",)),
    ),
)


def scenario_for(part: Part, number: int, steps: int) -> Scenario:
    """Scenario `number` of a part: of its kinds in turn, with the numbers that its deleters ask for."""
    kind = KINDS.index(part.kinds[number % len(part.kinds)])
    scenario = random_scenario(number * len(KINDS) + kind, steps)
    missed = int(np.random.default_rng(number).integers(2, 9))
    # A whole number of steps: there only exact sums of their durations decide rightly.
    limits = {"update_time": {"deletion_time": missed * scenario.params.time_step}}
    limits["update_time_steps"] = {"deletion_steps": missed}
    asked: dict[str, Any] = {}
    for deleter in part.static.deleters:
        asked |= limits.get(deleter, {})
    scenario = dataclasses.replace(scenario, params=dataclasses.replace(scenario.params, **asked))
    return away_from_the_seam(scenario) if part.static.filter == "cubature" else scenario


def away_from_the_seam(scenario: Scenario) -> Scenario:
    """The scenario without detections near the seam of bearings, or so high that bearings are wide."""
    value, active = np.asarray(scenario.detections.value), np.asarray(scenario.detections.active)
    plain = (np.abs(value[..., 1]) < np.pi - 0.2) & (np.abs(value[..., 0]) < 1.3)
    return dataclasses.replace(scenario, detections=scenario.detections.replace(active=active & plain))


def part_rows(
    parts: Sequence[Part], first: int, episodes: int, steps: int, processes: int, follow: Follow
) -> tuple[list[Row], list[str]]:
    """One row per part, and every first divergence in one line.

    Args:
        parts: which.
        first: number of the first scenario of each part.
        episodes: scenarios of each part.
        steps: of each scenario.
        processes: for Stone Soup.
        follow: shows progress over an iterable of the given length under the given name.
    """
    rows, divergences = [], list[str]()
    for part in parts:
        numbers = range(first, first + episodes)
        scenarios = [scenario_for(part, number, steps) for number in numbers]
        row, lines = part_row(part, numbers, scenarios, processes, follow)
        rows.append(row)
        divergences += lines
    return rows, divergences


def part_row(
    part: Part, numbers: range, scenarios: list[Scenario], processes: int, follow: Follow
) -> tuple[Row, list[str]]:
    """The row of one part from its scenarios."""
    double, single, stock = EpisodeTallies(), EpisodeTallies(), EpisodeTallies()
    exact = run_all([Job(scenario, static=part.static) for scenario in scenarios], processes)
    named = f"episodes, {part.stone_soup.partition(',')[0]}"
    pairs = zip(numbers, scenarios, exact, strict=True)
    for number, scenario, records in follow(pairs, len(numbers), named):
        double.add(number, compare(scenario, records, True, TOLERANCE, part.static))
        if part.is_filter:
            single.add(number, compare(scenario, records, False, SINGLE_TOLERANCE, part.static))
    if part.uses_jacobian:
        jobs = [Job(scenario, exact_jacobian=False, static=part.static) for scenario in scenarios]
        for number, scenario, records in zip(numbers, scenarios, run_all(jobs, processes), strict=True):
            stock.add(number, compare(scenario, records, True, STOCK_TOLERANCE, part.static))
    row = Row(
        part.component,
        f"{part.stone_soup}, {len(numbers):,} whole episodes",
        double.steps,
        "steps",
        float64=double.state.largest,
        float32=single.state.largest,
        stock=stock.state.largest,
        agreement=double.agreement,
        agreement32=single.agreement if part.is_filter else None,
        agreement_stock=stock.agreement if part.uses_jacobian else None,
        ties=double.ties,
        note=double.note(part.note),
    )
    named = divergences_of(part.component)
    return row, [f"{named}{number}: {line}" for number, line in double.divergences]


def divergences_of(component: str) -> str:
    """How the lines of a part's divergences begin."""
    (part,) = [part for part in PARTS if part.component == component]
    return f"{part.stone_soup}, scenario "
