"""What a training compiles, and the loop around it: rows of metrics, checkpoints, and when to stop."""

import math
import shlex
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
from rich.console import Console

from jaxtrack.env import SearchTrack
from jaxtrack.params import Params
from train import learner
from train.checkpoint import learner_shapes
from train.config import TrainConfig
from train.devices import Share, places, share_out, with_devices
from train.display import TrainingBar
from train.interrupt import Interrupt, exit_code
from train.learner_state import LearnerState
from train.run_folder import Run

FAILED = 1
LOST = "training diverged: {name} is {value} after update {update}"
HEALTH = ("policy_loss", "value_loss", "gradient_norm", "reward")
"""Metrics that end the training when they are not finite."""


class Programs(NamedTuple):
    """What a training runs; the same for all seeds of a configuration.

    Attributes:
        init: key of a seed, and params, to the first learner state; compiled when first called.
        step: learner state to the next one and its metrics; compiled. The state it is given is gone.
        places: on which devices the arrays of the state lie; None: on the first.
    """

    init: Callable[[jax.Array, Params], LearnerState]
    step: Callable[[LearnerState], tuple[LearnerState, dict[str, jax.Array]]]
    places: Any = None


def jit_training(env: Any, config: TrainConfig) -> tuple[Programs, LearnerState]:
    """What a training runs, not compiled yet, and the shapes of the learner state to compile its step for."""
    # From shapes alone, so that a resumed run compiles the very same program.
    shapes = learner_shapes(env, config)
    rows, number = shapes.of_environments(), config.devices
    where = places(rows, number)
    init = jax.jit(lambda key, params: learner.init_learner(key, params, env, config), out_shardings=where)
    step = share_out(lambda state: learner.train_step(state, env, config, Share(number)), rows, number)
    placed = jax.tree.map(
        lambda leaf, place: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), shapes, where
    )
    return Programs(init, jax.jit(step, donate_argnums=0), where), placed


def compile_training(run: Run, env: SearchTrack, console: Console) -> Programs:
    """Compiles, and says how long it took; what makes the first state only if the run has none yet."""
    started, config = time.perf_counter(), with_devices(run.config)
    jitted: Any
    jitted, shapes = jit_training(env, config)
    init = jitted.init
    with console.status("compiling (about half a minute)"), ThreadPoolExecutor(1) as pool:
        # Side by side: much of compiling keeps only one core busy.
        if run.state is None:
            first = pool.submit(init.lower(jax.random.key(config.seed), config.params).compile)
        step = jitted.step.lower(shapes).compile()
        if run.state is None:
            init = first.result()
    console.print(f"compiled in {time.perf_counter() - started:.1f} s; devices: {config.devices}")
    return Programs(init, step, jitted.places)


def first_state(run: Run, programs: Programs) -> LearnerState:
    """The learner state of the run's checkpoint, or a fresh one."""
    if run.state is not None:
        return jax.device_put(run.state, programs.places)
    return programs.init(jax.random.key(run.config.seed), run.config.params)


def train(
    state: LearnerState, programs: Programs, run: Run, interrupt: Interrupt, bar: TrainingBar
) -> tuple[LearnerState, int]:
    """Runs the updates that are left; one row of metrics each, a checkpoint now and then and at the end."""
    config, code = run.config, 0
    saved = run.done or None
    started = time.perf_counter() - run.metrics.seconds
    for update in range(run.done + 1, config.num_updates + 1):
        state, metrics = programs.step(state)
        row = make_row(jax.device_get(metrics), update, time.perf_counter() - started, run)
        lost = next((name for name in HEALTH if not math.isfinite(row[name])), None)
        if lost:
            bar.console.print(LOST.format(name=lost, value=row[lost], update=update))
            code = FAILED
            break
        run.metrics.write(row)
        bar.tell(update, row)
        passed = run.passed
        last = interrupt.signal or passed or update == config.num_updates
        if last or update % config.checkpoint_every == 0:
            run.save(state)
            saved = update
        if passed:
            bar.console.print(f"ended after update {update}: {passed}")
        if interrupt.signal:
            code = exit_code(interrupt.signal)
        if last:
            break
    if code:
        bar.stop()
        say_stopped(update, saved, run, code)
    return state, code


def say_stopped(update: int, saved: int | None, run: Run, code: int) -> None:
    """Says what is left of a training that did not reach its end; not wrapped, so that it can be copied."""
    if saved is None:
        print(f"stopped after {update} updates; no checkpoint yet in {run.folder}, so nothing to evaluate")
        return
    print(f"stopped after {update} updates; checkpoint of update {saved} in {run.folder}")
    if code != FAILED:
        print(f"continue with: {run.resume_command}")
    print(f"evaluate it with: python -m train.evaluate --run {shlex.quote(str(run.folder))}")


def make_row(metrics: dict[str, Any], update: int, seconds: float, run: Run) -> dict[str, float]:
    """One row of metrics.csv; the clock's columns span all parts of a resumed training that have rows."""
    batch = run.config.batch_size
    speed = (update - run.metrics.lost) * batch / seconds
    clock = {"update": update, "env_steps": update * batch, "seconds": seconds, "steps_per_second": speed}
    return {**clock, **{name: float(value) for name, value in metrics.items()}}
