"""A policy of ours steers the radar in a Stone Soup simulation: `python -m examples.stone_soup_manager`.

Everything but the policy is Stone Soup's: truths, rotating radar, tracker, metrics, picture. Needs the
extra `reference`: `pip install -e ".[reference]"`.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.track import Track

from jaxtrack.cli import parse, require_file, require_integer, run, wide_console
from jaxtrack.managers import MANAGERS
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import POLICIES, PolicyBuilder
from jaxtrack.types import POSITION
from reference.components import build_components, gospa_metric
from reference.parity.stock_metrics import siap_generator, track_to_truth
from reference.policy_manager import PolicyManager, build_agile_radar
from reference.simulation import StoneSoupScenario
from reference.truths import initial_states, num_initial, truth_simulator
from train.agents import agent_policy
from train.saved_run import load_run

BASELINE = "random"


@dataclasses.dataclass(frozen=True)
class ManagerOptions:
    """Lets a policy steer the radar in a Stone Soup simulation, and a random one beside it."""

    policy: str = "index"
    """Name of a policy or planner: random, static, coverage, stalest, scheduler, index, index_tuned,
    gain, sweep, sweep_then_track, greedy, rollout, uncertainty."""
    run: Path | None = None
    """Folder of a trained run, whose agent steers instead, in the scenario that it was trained on."""
    greedy: bool = False
    """Let the agent take its most probable look instead of sampling."""
    steps: int = 400
    """Number of looks."""
    seed: int = 0
    """Of the truths and of the radar's noise."""
    picture: Path | None = None
    """Image file for truths, detections and tracks from above, by Stone Soup's plotter."""


class Played(NamedTuple):
    """What came of one simulation: all tracks, truths and detections."""

    tracks: set[Track]
    paths: set[GroundTruthPath]
    detections: set[Detection]


def simulate(build: PolicyBuilder, static: StaticParams, params: Params, steps: int, seed: int) -> Played:
    """A stock simulation, in which only the decisions are ours; the same truths for the same seed."""
    rng = np.random.default_rng(seed)
    motion_seed, radar_seed = (int(number) for number in rng.integers(2**31, size=2))
    states = initial_states(rng, num_initial(static, params), params)
    params = dataclasses.replace(params, max_steps_in_episode=steps)
    simulator = truth_simulator(states, motion_seed, params)
    radar = build_agile_radar(params, radar_seed)
    manager = PolicyManager(build, static, params, seed=seed, sensors={radar})
    tracker = build_components(params, exact_jacobian=False).tracker()
    tracks: set[Track] = set()
    paths: set[GroundTruthPath] = set()
    detections: set[Detection] = set()
    for now, living in itertools.islice(simulator, 1, None):
        (config,) = manager.choose_actions(tracker.tracks, now)
        radar.add_actions(config[radar])
        radar.act(now)
        # In order, although the radar asks for a set: its noise goes to truths one by one.
        found = radar.measure([path[-1] for path in living])
        tracker.update_tracker(now, found)
        tracks |= tracker.tracks
        paths |= set(living)
        detections |= found
    return Played(tracks, paths, detections)


def judge(played: Played, params: Params) -> tuple[float, float]:
    """Completeness (SIAP) and mean GOSPA distance (m) by Stone Soup's metrics."""
    completeness, gospa = siap_generator(), gospa_metric(params)
    manager = MultiManager([completeness, gospa], track_to_truth(params))
    manager.add_data({"tracks": played.tracks, "groundtruth_paths": played.paths})
    found = manager.generate_metrics()
    distances = [one.value["distance"] for one in found[gospa.generator_name]["GOSPA Metrics"].value]
    share = found[completeness.generator_name]["SIAP Completeness"].value
    return float(share), float(np.mean(distances))


def draw(played: Played, path: Path) -> None:
    """Draws the simulation from above."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from stonesoup.plotter import Plotter

    plotter = Plotter()
    plotter.plot_ground_truths(played.paths, POSITION[:2])
    plotter.plot_measurements(played.detections, POSITION[:2], marker=".")
    plotter.plot_tracks(played.tracks, POSITION[:2], marker=".", markersize=2)
    plotter.fig.savefig(path)
    pyplot.close(plotter.fig)


def chosen(options: ManagerOptions) -> tuple[str, PolicyBuilder, StaticParams, Params]:
    """Name and builder of the policy, and its scenario.

    Raises:
        ValueError: naming the option.
    """
    require_integer("steps", options.steps, 2)
    require_integer("seed", options.seed, 0)
    if options.picture is not None:
        require_file("picture", options.picture)
    if options.run is not None:
        config, env, weights = load_run(options.run)
        StoneSoupScenario(env.static, config.params)  # refuses what is not simulated here
        return (
            str(options.run),
            agent_policy(config.encoder, weights, options.greedy, config.head),
            env.static,
            config.params,
        )
    known = {**POLICIES, **MANAGERS}
    if options.policy not in known:
        raise ValueError(f"policy = {options.policy!r}: expected one of {', '.join(known)}")
    return options.policy, known[options.policy], StaticParams(), Params()


def main(argv: Sequence[str]) -> int:
    """Simulates and prints the table."""
    options = parse(ManagerOptions(), argv, "python -m examples.stone_soup_manager")
    name, build, static, params = chosen(options)
    table = Table("sensor manager", "looks", "tracks", "completeness", "GOSPA (m)")
    played = {}
    for manager, builder in {name: build, BASELINE: POLICIES[BASELINE]}.items():
        played[manager] = simulate(builder, static, params, options.steps, options.seed)
        completeness, gospa = judge(played[manager], params)
        tracks = str(len(played[manager].tracks))
        table.add_row(manager, str(options.steps), tracks, f"{completeness:.2f}", f"{gospa:.0f}")
    wide_console().print(table)
    if options.picture is not None:
        draw(played[name], options.picture)
        print(f"{name}: picture in {options.picture}")
    return 0


if __name__ == "__main__":
    run(main)
