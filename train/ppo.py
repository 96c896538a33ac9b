"""The main job: `python -m train.ppo` trains an agent, evaluates it, and draws what it learned."""

import dataclasses
import math
import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import Progress

from jaxtrack.cli import INTERRUPTED, parse, run, take_config, wide_console
from jaxtrack.env import SearchTrack, make
from jaxtrack.scenarios import RECORDING, read_scenario
from train import learner
from train.checkpoint import learner_shapes
from train.config import TrainConfig, from_dict
from train.display import columns, note, print_config, say_now_and_then
from train.evaluate import COMPARED_SEED, agent, compare_with_baselines
from train.interrupt import Interrupt, exit_code
from train.learner import LearnerState
from train.recorded import with_recording
from train.results import print_results, summarise, write_results
from train.run_folder import Run, require_unchanged, resume_run, start_run
from train.saved_run import read_config

FAILED = 1
LOST = "training diverged: {name} is {value} after update {update}"
NOT_SAVED = ("resume", "scenario")
"""Options that are no part of a run's configuration: what a scenario sets stands there as fields."""
PROG = "python -m train.ppo"
HELP = (
    "Trains an agent for SearchTrack-v0 by PPO, compares it with all baselines on the same "
    "scenarios, and draws a learning curve and an episode. --config FILE (.toml or .json) sets "
    "the defaults of everything below; options on the command line win over it."
)


@dataclasses.dataclass(frozen=True)
class Options(TrainConfig):
    """A new training, or the folder of one to continue."""

    resume: str = ""
    """Folder of an interrupted run to continue; beside it only --evaluation-episodes may be given."""
    scenario: str = ""
    """Scenario by name (paper, clutter, births, agile, turning, accelerating, crowd, swarm, slow, flying,
    continuous), or a .toml or .json file with fields of Params and StaticParams, or a .csv file of OpenSky
    state vectors. It sets the defaults of these below, and --recording."""


def main(argv: Sequence[str]) -> int:
    """The command; returns the exit code."""
    opened = open_run(argv)
    console = wide_console()
    advice = ""
    try:
        with opened as run:
            advice = f"; continue with: {run.resume_command}"
            if run.finished:
                console.print(f"{run.folder}: the training had finished, nothing is left to do")
                return 0
            return execute(run, console)
    except OSError as error:  # disk full, folder gone or read-only, another training in it
        print(f"error: {error}{advice}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(f"interrupted{advice}", file=sys.stderr)
        return INTERRUPTED


def open_run(argv: Sequence[str]) -> AbstractContextManager[Run]:
    """The run that the arguments ask for, not yet opened."""
    values, rest = take_config(argv)
    options = _parse(from_dict(values), rest)
    if not options.resume:
        if options.scenario:
            options = _parse(on_scenario(from_dict(values), options.scenario), rest)
        return start_run(with_recording(_config(options)))
    for name, given in (("config", values), ("scenario", options.scenario)):
        if given:
            raise ValueError(f"{name}: expected none beside --resume, which takes the run's own")
    folder = Path(options.resume)
    own, saved = read_config(folder)
    wanted = _config(_parse(from_dict(saved), rest))
    require_unchanged(own, wanted)
    return resume_run(folder, wanted.evaluation_episodes)


def on_scenario(config: TrainConfig, name: str) -> TrainConfig:
    """The configuration with the fields of a scenario.

    Raises:
        ValueError: naming what is wrong with the scenario.
    """
    fields = read_scenario(name)
    recording = name if Path(name).suffix == RECORDING else ""
    if "trajectories" in fields and not recording:
        raise ValueError(f"scenario = {name!r}: expected trajectories in a {RECORDING} file, not in this one")
    env, params = make(config.params, config.static, **fields)
    params = dataclasses.replace(params, trajectories=None)  # read again, as options may change the rest
    return dataclasses.replace(
        config, static=env.static, params=params, recording=recording, recording_sha256=""
    )


def _parse(config: TrainConfig, argv: Sequence[str]) -> Options:
    return parse(Options(**vars(config)), argv, PROG, HELP)


def _config(options: Options) -> TrainConfig:
    return TrainConfig(**{name: value for name, value in vars(options).items() if name not in NOT_SAVED})


def execute(run: Run, console: Console) -> int:
    """Trains, as far as that was not done before, and evaluates; returns the exit code."""
    code = 0
    with Interrupt(f"continue with: {run.resume_command}") as interrupt:
        print_config(run.config, run.folder, console)
        env, _ = make(run.config.params, run.config.static)
        if run.trained:
            console.print("the training had finished, what follows it had not")
            state = first_state(run, env)
        else:
            state, compiled = compile_training(run, env, console)
            state, code = train(state, compiled, run, interrupt, console)
    if code == 0 and run.evaluation_episodes:
        finish(state, env, run, console)
    return code


def first_state(run: Run, env: SearchTrack) -> LearnerState:
    """The learner state of the run's checkpoint, or a fresh one."""
    if run.state is not None:
        return run.state
    init = jax.jit(lambda key, params: learner.init_learner(key, params, env, run.config))
    return init(jax.random.key(run.config.seed), run.config.params)


def compile_training(run: Run, env: SearchTrack, console: Console) -> tuple[LearnerState, Any]:
    """First learner state and the compiled training step; says how long compiling took."""
    started = time.perf_counter()
    with console.status("compiling (about half a minute)"):
        state = first_state(run, env)
        step = jax.jit(lambda state: learner.train_step(state, env, run.config), donate_argnums=0)
        # From shapes alone, so that a resumed run compiles the very same program.
        compiled = step.lower(learner_shapes(env, run.config)).compile()
    console.print(f"compiled in {time.perf_counter() - started:.1f} s")
    return state, compiled


def train(
    state: LearnerState, compiled: Any, run: Run, interrupt: Interrupt, console: Console
) -> tuple[LearnerState, int]:
    """Runs the updates that are left; one row of metrics each, a checkpoint now and then and at the end."""
    config, code = run.config, 0
    saved = run.done or None
    started = time.perf_counter() - run.metrics.seconds
    with Progress(*columns(), console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("training", total=config.num_updates * config.batch_size, note="")
        for update in range(run.done + 1, config.num_updates + 1):
            state, metrics = compiled(state)
            row = make_row(jax.device_get(metrics), update, time.perf_counter() - started, run)
            lost = next((name for name in HEALTH if not math.isfinite(row[name])), None)
            if lost:
                console.print(LOST.format(name=lost, value=row[lost], update=update))
                code = FAILED
                break
            run.metrics.write(row)
            progress.update(task, completed=row["env_steps"], note=note(row))
            say_now_and_then(update, row, config, console)
            passed = run.passed
            last = interrupt.signal or passed or update == config.num_updates
            if last or update % config.checkpoint_every == 0:
                run.save(state)
                saved = update
            if passed:
                console.print(f"ended after update {update}: {passed}")
            if interrupt.signal:
                code = exit_code(interrupt.signal)
            if last:
                break
    if code:
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


HEALTH = ("policy_loss", "value_loss", "gradient_norm", "reward")
"""Metrics that end the training when they are not finite."""


def make_row(metrics: dict[str, Any], update: int, seconds: float, run: Run) -> dict[str, float]:
    """One row of metrics.csv; the clock's columns span all parts of a resumed training that have rows."""
    batch = run.config.batch_size
    speed = (update - run.metrics.lost) * batch / seconds
    clock = {"update": update, "env_steps": update * batch, "seconds": seconds, "steps_per_second": speed}
    return {**clock, **{name: float(value) for name, value in metrics.items()}}


def finish(state: LearnerState, env: SearchTrack, run: Run, console: Console) -> None:
    """Evaluates the trained agent against the baselines; draws pictures and writes tables."""
    from jaxtrack.recording import record_episode
    from jaxtrack.render import animate
    from train import figures, plots

    started = time.perf_counter()
    config, folder = run.config, run.folder
    competitor = agent(config, [state.weights], (config.seed,))
    comparison = compare_with_baselines(
        config.encoder, competitor, env, config.params, run.evaluation_episodes, COMPARED_SEED, console
    )
    summary = summarise(comparison.played)
    print_results(comparison, summary, [config.encoder], console)
    console.print(f"evaluated in {time.perf_counter() - started:.1f} s")
    plots.learning_curve(folder / "metrics.csv", folder / "learning_curve.png")
    drawn = figures.draw_all(comparison.played, summary, config.params, folder)
    policy = competitor.build(state.weights)(env.static, config.params)
    episode = record_episode(env, config.params, policy, jax.random.key(COMPARED_SEED))
    animate(episode, folder / "episode.gif", progress=console.is_terminal)
    write_results(comparison, summary, env, config.params, COMPARED_SEED, folder)
    pictures = ["learning_curve.png", *(path.name for path in drawn.values()), "episode.gif"]
    console.print(f"results.json, episodes.csv, curves.npz, {', '.join(pictures)} in {folder}")


if __name__ == "__main__":
    run(main)
