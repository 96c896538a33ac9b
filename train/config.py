"""The configuration of a training run: one dataclass, checked before anything is written."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from jaxtrack.cli import LARGEST_SEED
from jaxtrack.params import Params, StaticParams
from jaxtrack.policies import POLICIES
from jaxtrack.validation import validate
from train.agents import AGENTS
from train.early_stop import Thresholds, check_thresholds
from train.networks import ENCODERS, HEADS
from train.ranges import Ranges, check_ranges
from train.vision import SMALLEST_MAP

NO_WARM_START = "none"

PIECE_SIZES = {"beams": 128}
"""Samples per piece of a gradient that suit an agent's network; 64 where nothing is said."""


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything a run depends on; saved beside its results as config.json."""

    encoder: str = "beams"
    """Policy to train: beams (what a beam would search and what the tracks in it need), or the
    paper's track-list encoders flatten, bigru, mhsa."""
    head: str = "beams"
    """How the paper's networks choose a look: beams (worths of what lies in each beam), joint (one
    softmax over all looks), factored (azimuth and elevation apart, as in the paper), or, where actions
    are continuous, gaussian (any angle; the others take the angles of discrete looks)."""
    total_steps: int = 400_000
    """Environment steps, rounded down to whole updates."""
    num_envs: int = 64
    """Environments that run side by side."""
    devices: int = 0
    """Cores of the CPU, or accelerators, that share the environments and the learning; it changes nothing
    but speed and rounding. 0: as many as there are and can share equally; config.json says how many."""
    seed: int = 0
    """Seed of everything random."""
    out: str = ""
    """Folder of the run; it must not exist. Empty: runs/ENCODER-seedSEED-TIME."""
    evaluation_episodes: int = 100
    """Scenarios on which the agent and all baselines are compared at the end; 0 skips it."""
    checkpoint_every: int = 20
    """Updates between checkpoints; one is always written at the end."""

    pretrain_steps: int = 0
    """Environment steps with random looks on which one of the paper's encoders learns to reproduce track
    lists, as an auto-encoder, before anything else."""
    warm_start: str = "sweep_then_track"
    """Rule that the policy imitates at first, a baseline by name; none: it learns from rewards alone."""
    warm_start_steps: int = 150_000
    """Environment steps of that, out of the total, rounded down to whole updates."""
    warm_start_learning_rate: float = 1e-3
    """Adam's step size meanwhile."""

    rollout_steps: int = 256
    """Steps of every environment per update."""
    epochs: int = 4
    """Passes over the samples of an update."""
    num_minibatches: int = 8
    """Optimiser steps per pass."""
    microbatch: int = 0
    """Samples per piece of a gradient, for the cache; changes nothing but speed and rounding. 0: at
    most 128 for beams, 32 for the paper's encoders."""
    learning_rate: float = 1e-5
    """Adam's step size when learning from rewards starts. Without a warm start, 3e-3 learns faster."""
    anneal: bool = True
    """Let the learning rate fall to zero from there, linearly."""
    gamma: float = 0.995
    """Discount per step."""
    gae_lambda: float = 0.9
    """Decay of the advantage estimate."""
    clip: float = 0.2
    """Largest change of a probability ratio that is rewarded."""
    target_kl: float = 0.05
    """An update leaves out the rest of its optimiser steps once the policy, by the samples of a minibatch,
    is further than 1.5 times this from the one that acted (nats); not while it imitates. 0: never."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    value_coefficient: float = 0.5
    """Weight of the value error."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this global norm."""
    reward_scale: float = 0.1
    """Factor on rewards in the learner, so that values are near 1; logged returns are unscaled."""

    stop_above: Thresholds = dataclasses.field(default_factory=dict)
    """The training ends after the first update, the warm start aside, in which a column of metrics.csv
    is above, as in completeness=0.9; it is evaluated as if it were at its end."""
    stop_below: Thresholds = dataclasses.field(default_factory=dict)
    """The same for a column that is below."""

    curriculum: Ranges = dataclasses.field(default_factory=dict)
    """Numbers of the environment that move linearly, update by update, as in clutter_rate=0:0.2; a
    table of pairs in a configuration file. `params` then count for the evaluation alone."""
    curriculum_share: float = 0.5
    """Share of the training after which the curriculum has arrived."""
    randomise: Ranges = dataclasses.field(default_factory=dict)
    """Numbers that every episode draws uniformly, as in detection_probability=0.8:1 initial_truths=2:10.
    The agent is not told; `params` count for the evaluation, and for all that the agent computes."""

    recording: str = ""
    """File of OpenSky state vectors whose aircraft are the truths; --scenario FILE.csv sets it, and the
    numbers that suit it. It must stay where it is for as long as the run is to be resumed or played."""
    recording_sha256: str = ""
    """Digest of that file; it is filled in, and a file with another one is refused."""

    static: StaticParams = dataclasses.field(
        default_factory=lambda: StaticParams(
            reward="shortfall", search_sharpness=16, search_until_complete=True, observe_variances=True
        )
    )
    """Shapes of the environment."""
    params: Params = dataclasses.field(default_factory=lambda: Params(search_weight=3.0))
    """Numbers of the environment."""

    @property
    def batch_size(self) -> int:
        """Samples per update."""
        return self.num_envs * self.rollout_steps

    @property
    def minibatch_size(self) -> int:
        """Samples per optimiser step."""
        return self.batch_size // self.num_minibatches

    @property
    def piece_size(self) -> int:
        """Samples per piece of a gradient: `microbatch`, or the largest divisor that suits the encoder."""
        own = self.minibatch_size // max(1, self.devices)
        return self.microbatch or math.gcd(own, PIECE_SIZES.get(self.encoder, 64))

    @property
    def group_size(self) -> int:
        """Environments whose samples are shuffled together: the fewest that give every minibatch as many."""
        divisors = (size for size in range(1, self.num_envs + 1) if self.num_envs % size == 0)
        return next(size for size in divisors if size * self.rollout_steps % self.num_minibatches == 0)

    @property
    def shared(self) -> tuple[int, int]:
        """Groups of environments, and smallest pieces of a minibatch, that devices can share."""
        return self.num_envs // self.group_size, self.minibatch_size // (self.microbatch or 1)

    def shares_equally(self, devices: int) -> bool:
        """Whether so many devices can have as many groups and pieces each."""
        return all(number % devices == 0 for number in self.shared)

    @property
    def warm_start_updates(self) -> int:
        """Updates in which the policy imitates a rule."""
        return 0 if self.warm_start == NO_WARM_START else self.warm_start_steps // self.batch_size

    @property
    def num_updates(self) -> int:
        """Updates of the whole run."""
        return self.total_steps // self.batch_size


_AT_LEAST_ONE = ("total_steps", "num_envs", "rollout_steps", "epochs", "num_minibatches")
_SHARES = ("gamma", "gae_lambda")
_POSITIVE = ("learning_rate", "warm_start_learning_rate", "clip", "max_grad_norm", "reward_scale")
_NOT_NEGATIVE = ("target_kl", "entropy_coefficient", "value_coefficient")


def check(config: TrainConfig) -> None:
    """Refuses a configuration that can not run.

    Raises:
        ValueError: one line that names the field, its value and what is allowed.
    """
    if config.encoder not in AGENTS:
        raise ValueError(f"encoder = {config.encoder!r}: expected one of {', '.join(AGENTS)}")
    _require(config, "head", config.head in HEADS, f"one of {', '.join(HEADS)}")
    for name in _AT_LEAST_ONE:
        _require(config, name, getattr(config, name) >= 1, "an integer >= 1")
    teachers = (NO_WARM_START, *POLICIES)
    _require(config, "warm_start", config.warm_start in teachers, f"one of {', '.join(teachers)}")
    in_range = 0 <= config.seed <= LARGEST_SEED
    _require(config, "seed", in_range, f"an integer in [0, {LARGEST_SEED}]")
    for name in ("evaluation_episodes", "warm_start_steps", "pretrain_steps", "microbatch", "devices"):
        _require(config, name, getattr(config, name) >= 0, "an integer >= 0")
    if config.encoder not in ENCODERS:
        _require(config, "head", config.head == "beams", f"beams, the head of {config.encoder}")
        _require(config, "pretrain_steps", config.pretrain_steps == 0, f"0, {config.encoder} has no encoder")
    _require(config, "checkpoint_every", config.checkpoint_every >= 1, "an integer >= 1")
    for name in _SHARES:
        _require(config, name, 0 <= getattr(config, name) <= 1, "a number in [0, 1]")
    for name in _POSITIVE:
        _require(config, name, 0 < getattr(config, name) < math.inf, "a number > 0")
    for name in _NOT_NEGATIVE:
        _require(config, name, 0 <= getattr(config, name) < math.inf, "a number >= 0")
    _check_batches(config)
    if config.encoder in ENCODERS and config.static.map_size < SMALLEST_MAP:
        raise ValueError(
            f"static.map_size = {config.static.map_size}: expected an integer >= {SMALLEST_MAP} for NatureCNN"
        )
    of_indices = ", ".join(name for name in HEADS if name != "gaussian")
    is_possible = config.static.continuous_actions or config.head != "gaussian"
    _require(config, "head", is_possible, f"one of {of_indices} without static.continuous_actions")
    validate(config.static, config.params)
    is_read = bool(config.recording) == (config.params.trajectories is not None)
    _require(config, "recording", is_read, "the file of params.trajectories, as --scenario FILE.csv")
    for name in ("stop_above", "stop_below"):
        check_thresholds(name, getattr(config, name), config.static.info_metrics)
    _require(config, "curriculum_share", 0 < config.curriculum_share <= 1, "a number in (0, 1]")
    tables = {"curriculum": config.curriculum, "randomise": config.randomise}
    check_ranges(tables, config.static, config.params)
    out = Path(config.out)
    _require(config, "out", not config.out or not out.exists(), "a folder that does not exist yet")


def _check_batches(config: TrainConfig) -> None:
    samples = f"num_envs x rollout_steps = {config.batch_size}"
    _require(
        config,
        "num_minibatches",
        config.batch_size % config.num_minibatches == 0,
        f"a divisor of {samples} samples",
    )
    _require(
        config,
        "microbatch",
        config.minibatch_size % config.piece_size == 0,
        f"a divisor of the minibatch of {config.minibatch_size} samples",
    )
    groups, pieces = config.shared
    shares = config.shares_equally(max(1, config.devices))
    divided = f"{groups} groups of environments and {pieces} pieces of a minibatch"
    _require(config, "devices", shares, f"0, or a divisor of {divided}")
    _require(config, "total_steps", config.num_updates >= 1, f"at least one update: >= {samples}")


def _require(config: TrainConfig, name: str, holds: bool, expected: str) -> None:
    if not holds:
        raise ValueError(f"{name} = {getattr(config, name)!r}: expected {expected}")


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Plain nested dictionary, for JSON; without trajectories, which `recording` names."""
    params = dataclasses.replace(config.params, trajectories=None)
    return dataclasses.asdict(dataclasses.replace(config, params=params))


def first_difference(these: Any, those: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """Name and both values of the first field, by name, in which two nested dictionaries differ."""
    if not (isinstance(these, dict) and isinstance(those, dict)):
        return None if these == those else (name, these, those)
    for key in sorted({*these, *those}):
        inner = f"{name}.{key}" if name else key
        if found := first_difference(these.get(key), those.get(key), inner):
            return found
    return None


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """Inverse of `to_dict`; missing fields keep their defaults.

    Raises:
        ValueError: naming a field that does not exist or has the wrong type.
    """
    default = TrainConfig()
    static = _replace(default.static, values.get("static", {}), "static.")
    params = _replace(default.params, values.get("params", {}), "params.")
    flat = {name: value for name, value in values.items() if name not in ("static", "params")}
    return _replace(dataclasses.replace(default, static=static, params=params), flat, "")


def _replace(default: Any, values: dict[str, Any], prefix: str) -> Any:
    if not isinstance(values, dict):
        raise ValueError(f"{prefix.rstrip('.')} = {values!r}: expected a table of fields")
    known = {field.name: _kinds(field.type) for field in dataclasses.fields(default)}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{prefix}{name}: no such field; expected one of {', '.join(sorted(known))}")
        allowed = (*known[name], int) if float in known[name] else known[name]
        if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
            raise ValueError(f"{prefix}{name} = {value!r}: expected {known[name][0].__name__}")
    return dataclasses.replace(default, **{name: _frozen(value) for name, value in values.items()})


def _frozen(value: Any) -> Any:
    """Tuples for lists, also in a table: JSON and TOML have no tuples."""
    if isinstance(value, dict):
        return {name: _frozen(inner) for name, inner in value.items()}
    return tuple(value) if isinstance(value, list) else value


def _kinds(annotation: Any) -> tuple[type, ...]:
    """Types that a field takes."""
    if get_origin(annotation) is Annotated:  # a table of numbers by name
        return (dict,)
    if get_origin(annotation) is tuple:
        return list, tuple
    return get_args(annotation) or (annotation,)
