"""The main job: `python -m train.ppo` trains an agent, evaluates it, and draws what it learned."""

from jaxtrack import cores

if __name__ == "__main__":
    cores.use()  # before gymnax is imported, which starts JAX

import dataclasses
import shlex
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from jaxtrack.cli import INTERRUPTED, parse, run, take_config, wide_console
from jaxtrack.env import SearchTrack, make
from jaxtrack.scenarios import RECORDING, read_scenario
from train.config import TrainConfig, from_dict, to_dict
from train.display import TrainingBar, print_config
from train.evaluate import COMPARED_SEED, agent, compare_with_baselines
from train.interrupt import Interrupt, exit_code
from train.learner_state import LearnerState
from train.loop import FAILED, compile_training, first_state, train
from train.recorded import with_recording
from train.results import print_results, summarise, write_results
from train.run_folder import Run, require_unchanged, resume_run, start_run
from train.saved_run import read_config
from train.seeds import Seeds, holds_seeds, read_seeds, start_seeds

NOT_SAVED = ("seeds", "resume", "scenario")
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

    seeds: int = 1
    """Number of trainings, one after the other in one program, with the seeds from --seed on. Each has
    its own folder in --out, as if it were alone; at the end all are evaluated together."""
    resume: str = ""
    """Folder of an interrupted run, or of several seeds, to continue; beside it only
    --evaluation-episodes may be given."""
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
            return execute_seeds(run, console) if isinstance(run, Seeds) else execute(run, console)
    except OSError as error:  # disk full, folder gone or read-only, another training in it
        print(f"error: {error}{advice}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(f"interrupted{advice}", file=sys.stderr)
        return INTERRUPTED


def open_run(argv: Sequence[str]) -> AbstractContextManager[Run | Seeds]:
    """The run that the arguments ask for, or the runs of several seeds, not yet opened."""
    values, rest = take_config(argv)
    options = _parse(from_dict(values), rest)
    if not options.resume:
        if options.scenario:
            options = _parse(on_scenario(from_dict(values), options.scenario), rest)
        config = with_recording(_config(options))
        return start_run(config) if options.seeds == 1 else start_seeds(config, options.seeds)
    for name, given in (("config", values), ("scenario", options.scenario)):
        if given:
            raise ValueError(f"{name}: expected none beside --resume, which takes the run's own")
    return open_again(Path(options.resume), rest)


def open_again(folder: Path, argv: Sequence[str]) -> AbstractContextManager[Run | Seeds]:
    """The run of a folder, or the runs of several seeds, that the arguments want to continue.

    Raises:
        ValueError: one line, if there is none, or if the arguments would change it.
    """
    several = read_seeds(folder) if holds_seeds(folder) else None
    own, number = (several.config, several.number) if several else (read_config(folder)[0], 1)
    options = _parse(from_dict(to_dict(own)), argv, number)  # read again, a recording is no option
    wanted = _config(options)
    if options.seeds != number:
        raise ValueError(f"seeds = {options.seeds}: expected {number} as in the run")
    require_unchanged(own, wanted)
    if several is None:
        return resume_run(folder, wanted.evaluation_episodes)
    return nullcontext(dataclasses.replace(several, evaluation_episodes=wanted.evaluation_episodes))


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


def _parse(config: TrainConfig, argv: Sequence[str], seeds: int = 1) -> Options:
    return parse(Options(**vars(config), seeds=seeds), argv, PROG, HELP)


def _config(options: Options) -> TrainConfig:
    return TrainConfig(**{name: value for name, value in vars(options).items() if name not in NOT_SAVED})


def execute(run: Run, console: Console) -> int:
    """Trains, as far as that was not done before, and evaluates; returns the exit code."""
    code = 0
    env, _ = make(run.config.params, run.config.static)
    with (
        Interrupt(f"continue with: {run.resume_command}") as interrupt,
        TrainingBar(run.config, console) as bar,
    ):
        print_config(run.config, run.folder, console)
        if run.state is not None and run.trained:
            console.print("the training had finished, what follows it had not")
            state = run.state
        else:
            programs = compile_training(run, env, console)
            bar.begin("training", done=run.done)
            state, code = train(first_state(run, programs), programs, run, interrupt, bar)
    if code == 0 and run.evaluation_episodes:
        finish(state, env, run, console)
    return code


def execute_seeds(seeds: Seeds, console: Console) -> int:
    """Trains the seeds that are left, one after the other, and evaluates all together; the exit code."""
    weights: dict[int, Any] = {}
    programs, code = None, 0
    env, _ = make(seeds.config.params, seeds.config.static)
    with (
        Interrupt(f"continue with: {seeds.resume_command}") as interrupt,
        TrainingBar(seeds.config, console, seeds.number) as bar,
    ):
        print_config(seeds.config, seeds.folder, console)
        for place, seed in enumerate(seeds.seeds):
            with seeds.open(seed) as run:
                state, code = run.state, 0
                if state is None or not run.trained:
                    programs = programs or compile_training(run, env, console)
                    name = f"seed {seed} ({place + 1} of {seeds.number})"
                    console.print(f"{name}: {run.folder}")
                    bar.begin(name, place, run.done)
                    state, code = train(first_state(run, programs), programs, run, interrupt, bar)
            if interrupt.signal:
                if not code:  # it came between two trainings
                    print(f"continue with: {seeds.resume_command}")
                return exit_code(interrupt.signal)
            if code == 0:
                weights[seed] = jax.device_get(state.weights)
        if programs is None:
            left = "what follows it had not" if seeds.evaluation_episodes else "nothing is left to do"
            console.print(f"the training had finished, {left}")
    return finish_seeds(weights, env, seeds, console)


def finish_seeds(weights: dict[int, Any], env: SearchTrack, seeds: Seeds, console: Console) -> int:
    """Evaluates all seeds together, if all were trained to their end; returns the exit code."""
    failed = [str(seed) for seed in seeds.seeds if seed not in weights]
    if failed:
        print(f"not all were trained to their end, so nothing is compared; missing: seed {', '.join(failed)}")
        if weights:
            runs = shlex.join(str(seeds.folder_of(seed)) for seed in weights)
            print(f"evaluate the others with: python -m train.evaluate --runs {runs}")
        return FAILED
    if seeds.evaluation_episodes:
        evaluate_agent(weights, env, seeds, seeds.folders, console)
    return 0


def finish(state: LearnerState, env: SearchTrack, run: Run, console: Console) -> None:
    """Evaluates the trained agent against the baselines; draws pictures and writes tables."""
    evaluate_agent({run.config.seed: jax.device_get(state.weights)}, env, run, [run.folder], console)


def evaluate_agent(
    weights: dict[int, Any], env: SearchTrack, trained: Run | Seeds, folders: Sequence[Path], console: Console
) -> None:
    """Evaluates an agent, by its weights of every seed, against the baselines.

    Learning curves go into the folders of the seeds, all else into that of what was trained.
    """
    from jaxtrack.recording import record_episode
    from jaxtrack.render import animate
    from train import figures, plots

    started = time.perf_counter()
    config, folder = trained.config, trained.folder
    competitor = agent(config, list(weights.values()), tuple(weights))
    comparison = compare_with_baselines(
        config.encoder, competitor, env, config.params, trained.evaluation_episodes, COMPARED_SEED, console
    )
    summary = summarise(comparison.played)
    print_results(comparison, summary, [config.encoder], console)
    console.print(f"evaluated in {time.perf_counter() - started:.1f} s")
    for own in folders:
        plots.learning_curve(own / "metrics.csv", own / "learning_curve.png")
    drawn = figures.draw_all(comparison.played, summary, config.params, folder)
    policy = competitor.build(competitor.weights[0])(env.static, config.params)
    episode = record_episode(env, config.params, policy, jax.random.key(COMPARED_SEED))
    animate(episode, folder / "episode.gif", progress=console.is_terminal)
    write_results(comparison, summary, env, config.params, COMPARED_SEED, folder)
    pictures = ["learning_curve.png", *(path.name for path in drawn.values()), "episode.gif"]
    console.print(f"results.json, episodes.csv, curves.npz, {', '.join(pictures)} in {folder}")


if __name__ == "__main__":
    run(main)
