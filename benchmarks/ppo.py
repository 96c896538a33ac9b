"""What the benchmarks beside Stable-Baselines3's PPO share: sizes of an update, and our side of it."""

import dataclasses
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax

from jaxtrack.cli import require_file, require_integer
from jaxtrack.params import Params, StaticParams
from jaxtrack.report import PACKAGES
from train.config import TrainConfig
from train.devices import with_devices
from train.learner_state import LearnerState
from train.loop import jit_training
from train.networks import ENCODERS

REPORTED = (*PACKAGES, "flax", "optax", "stable-baselines3", "torch")
"""Packages whose versions are reported."""


@dataclasses.dataclass(frozen=True)
class UpdateOptions:
    """Sizes of an update, the same for both learners, and what every such benchmark is asked."""

    encoders: tuple[str, ...] = tuple(ENCODERS)
    """Track-list encoders of the paper: flatten, bigru, mhsa."""
    num_envs: int = 64
    """Environments side by side."""
    rollout_steps: int = 128
    """Steps of every environment in one update."""
    minibatch_size: int = 1024
    """Samples per optimiser step."""
    epochs: int = 4
    """Passes over the samples of an update."""
    repeats: int = 5
    """Times that everything is timed."""
    seed: int = 0
    """Seed of both sides."""
    out: Path | None = None
    """JSON file for the results; nothing is written without it."""
    markdown: bool = False
    """Print the table in Markdown."""

    @property
    def samples(self) -> int:
        """Samples of an update."""
        return self.num_envs * self.rollout_steps


def check_update(options: UpdateOptions) -> None:
    """Raises ValueError, naming the option, before anything is measured."""
    for name in ("num_envs", "rollout_steps", "minibatch_size", "epochs", "repeats"):
        require_integer(name, getattr(options, name), 1)
    require_integer("seed", options.seed, 0)
    known = ", ".join(ENCODERS)
    if not options.encoders or len(set(options.encoders)) < len(options.encoders):
        raise ValueError(f"encoders = {options.encoders}: expected different ones of {known}")
    for encoder in options.encoders:
        if encoder not in ENCODERS:
            raise ValueError(f"encoders = {encoder!r}: expected some of {known}")
    if options.samples % options.minibatch_size:
        raise ValueError(
            f"minibatch_size = {options.minibatch_size}: expected a divisor of "
            f"num_envs x rollout_steps = {options.samples} samples"
        )
    if options.out is not None:
        require_file("out", options.out)


def load(module: str, extras: str) -> ModuleType:
    """The other side, imported only here: it loads PyTorch.

    Raises:
        ValueError: where one of the extras is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(f'{error.name} is not installed: pip install -e ".[{extras}]"') from None


def configure(encoder: str, options: UpdateOptions) -> TrainConfig:
    """The configuration of both learners; what is not an option is a default of `train.ppo`."""
    return TrainConfig(
        encoder=encoder,
        head="factored",
        num_envs=options.num_envs,
        rollout_steps=options.rollout_steps,
        num_minibatches=options.samples // options.minibatch_size,
        epochs=options.epochs,
        seed=options.seed,
        warm_start="none",
        anneal=False,
        target_kl=0.0,
        static=StaticParams(),
        params=Params(),
    )


class Seconds(NamedTuple):
    """How long something took."""

    wall: float
    """Time that passed (s)."""
    processor: float
    """Time of this process on all cores together (s), which other processes hardly change."""


def seconds_of(call: Callable[[], Any]) -> Seconds:
    """How long one call takes."""
    began = time.perf_counter(), time.process_time()
    call()
    return Seconds(time.perf_counter() - began[0], time.process_time() - began[1])


@dataclasses.dataclass
class OurLearner:
    """Our learner on an environment, compiled; a call is one update.

    Attributes:
        state: what it carries from one update to the next.
        compiled: the training step.
        compiling: what that took, tracing included.
    """

    state: LearnerState
    compiled: Callable[[LearnerState], tuple[LearnerState, dict[str, jax.Array]]]
    compiling: Seconds

    @property
    def parameters(self) -> int:
        """Weights that are trained."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.state.weights))

    def __call__(self) -> dict[str, jax.Array]:
        """One update; its metrics, when all is computed."""
        self.state, metrics = self.compiled(self.state)
        jax.block_until_ready((self.state, metrics))
        return metrics


def build_learner(config: TrainConfig, env: Any) -> OurLearner:
    """The first state of our learner, and its compiled training step."""
    jitted: Any
    jitted, shapes = jit_training(env, with_devices(config))
    state = jitted.init(jax.random.key(config.seed), config.params)
    programs: list[Any] = []
    compiling = seconds_of(lambda: programs.append(jitted.step.lower(shapes).compile()))
    return OurLearner(state, programs[0], compiling)
