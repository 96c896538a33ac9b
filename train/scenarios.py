"""The scenario in which policies are compared: one by name, from a file, or that of the runs."""

from collections.abc import Sequence

from jaxtrack.env import SearchTrack, make
from jaxtrack.params import Params
from jaxtrack.scenarios import read_scenario
from train.config import TrainConfig, to_dict

SCENARIO = ("static", "params", "recording_sha256")
"""What of a configuration says in which scenario it trains."""


def build_scenario(name: str, runs: Sequence[TrainConfig]) -> tuple[SearchTrack, Params]:
    """The environment and its numbers, checked.

    Args:
        name: of a scenario or a file; empty for that of the runs, or the paper's without one.
        runs: configurations of the runs.

    Raises:
        ValueError: naming what is wrong; also if no scenario is named and the runs have several.
    """
    if not name and runs:
        scenarios = [[to_dict(run)[part] for part in SCENARIO] for run in runs]
        if any(other != scenarios[0] for other in scenarios):
            raise ValueError("scenario: expected one by name, the runs were trained on different ones")
        return make(runs[0].params, runs[0].static)
    default = TrainConfig()
    return make(default.params, default.static, **read_scenario(name or "paper"))
