"""Whole episodes of both environments from the same draws: observations and rewards."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import models
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState, StepNoise
from jaxtrack.params import REWARDS, Params, StaticParams
from jaxtrack.reward import reward_terms
from jaxtrack.sensor import look_indices
from jaxtrack.truth import newborn_states, num_births
from jaxtrack.types import Truths
from reference.components import noise_sigmas, step_duration, transition_model
from reference.gym_env import StoneSoupEnv
from reference.parity.compare import TOLERANCE
from reference.parity.episodes import Divergence
from reference.parity.ours import cast
from reference.parity.rows import Row, Tally
from reference.simulation import StoneSoupScenario
from reference.translate import as_vector
from reference.truths import Draws

STATIC = StaticParams(num_truths=12, max_tracks=40, max_detections=20, map_size=24, search_sharpness=2)
"""Roomy: Stone Soup has no capacity."""

LIVELY = Params(
    time_step=0.02, deletion_threshold=3500.0, initial_truths=6, birth_rate=0.03, death_probability=0.004
)
"""Long steps, so that tracks die within an episode; truths are born and die."""


@dataclasses.dataclass(frozen=True)
class Played:
    """One episode of ours, K steps, on the host.

    Attributes:
        initial: the truths at the start.
        truths: `[K]` the truths after each step.
        noise: `[K]` all that was drawn.
        actions: `[K, 2]` look indices.
        observations: `[K]` observations.
        rewards: `[K]` rewards by name.
    """

    initial: Truths
    truths: Truths
    noise: StepNoise
    actions: np.ndarray
    observations: dict[str, np.ndarray]
    rewards: dict[str, np.ndarray]


def pointing_or_random(key: jax.Array, state: EnvState, env: SearchTrack, params: Params) -> jax.Array:
    """Half of the looks at one of three truths, half anywhere: updates, births and deletions."""
    elevation, azimuth, _ = models.elevation_bearing_range(state.truths.state[(state.time // 10) % 3])
    there = look_indices(jnp.stack([azimuth, elevation]), env.static, params)
    anywhere = jax.random.randint(key, (2,), 0, env.static.num_looks)
    return jnp.where(state.time % 2 == 0, anywhere, there)


def play_ours(static: StaticParams, params: Params, seed: int, steps: int) -> Played:
    """One episode of our environment in float64, with all rewards, whichever `static` names."""
    with jax.enable_x64(True):
        return Played(*jax.device_get(_episode(jax.random.key(seed), cast(params, True), static, steps)))


@partial(jax.jit, static_argnames=("static", "steps"))
def _episode(key: jax.Array, params: Params, static: StaticParams, steps: int) -> Any:
    env = SearchTrack(static)
    by_reward = {name: dataclasses.replace(static, reward=name) for name in REWARDS}

    def step(state: EnvState, key: jax.Array) -> tuple[EnvState, Any]:
        key_action, key_noise = jax.random.split(key)
        action = pointing_or_random(key_action, state, env, params)
        noise = env.sample_noise(key_noise)
        after, _ = env.advance(state, action, noise, params)
        rewards = {
            name: sum(reward_terms(state.tracks, after.tracks, after.truths, after.scan_map, named, params))
            for name, named in by_reward.items()
        }
        return after, (after.truths, noise, action, env.observe(key, after, action, params), rewards)

    key_reset, key_steps = jax.random.split(key)
    _, state = env.reset_env(key_reset, params)
    return state.truths, *jax.lax.scan(step, state, jax.random.split(key_steps, steps))[1]


def draws_of(played: Played, params: Params) -> Draws:
    """The same draws in the units that Stone Soup's side takes."""
    noise: Any = played.noise.truths
    shape = noise.motion.shape
    Q = transition_model(params.truth_process_noise).covar(time_interval=step_duration(params))
    factor = np.linalg.cholesky(Q[:2, :2]) if params.truth_process_noise else np.zeros((2, 2))
    with jax.enable_x64(True):
        births = jax.vmap(num_births, in_axes=(0, None))(noise, params)
        newborn = jax.vmap(newborn_states, in_axes=(0, None))(noise, params)
    return Draws(
        initial=np.asarray(played.initial.state)[np.asarray(played.initial.alive)],
        motion=(noise.motion @ factor.T).reshape(*shape[:2], 6),
        death=noise.death,
        births=np.asarray(births),
        newborn=np.asarray(newborn),
        detection=noise_sigmas(params) * played.noise.sensor.detection,
    )


@dataclasses.dataclass
class EnvironmentTallies:
    """What is collected over episodes: of observations and rewards, and of the truths."""

    seen: Tally = dataclasses.field(default_factory=Tally)
    truths: Tally = dataclasses.field(default_factory=Tally)


def environment_rows(seeds: Iterable[int], steps: int) -> tuple[list[Row], list[Divergence]]:
    """Episodes with births and deaths, the rewards in turn; rows, and what diverged."""
    tallies, divergences = EnvironmentTallies(), []
    for seed in seeds:
        static = dataclasses.replace(STATIC, reward=REWARDS[seed % len(REWARDS)])
        divergence = compare_environment(static, LIVELY, seed, steps, TOLERANCE, tallies)
        divergences += [divergence] if divergence else []
    simulator = "MultiTargetGroundTruthSimulator: transition, birth, death"
    rows = [
        tallies.truths.row("truth.propagate_truths", simulator, "truth states"),
        tallies.seen.row("env.step: observation, reward", "Gymnasium environment of stock parts", "arrays"),
    ]
    return rows, divergences


def compare_environment(
    static: StaticParams, params: Params, seed: int, steps: int, tolerance: float, tallies: EnvironmentTallies
) -> Divergence | None:
    """Plays Stone Soup's environment on our draws and actions; the first difference, if any.

    Errors are absolute, of scaled observations near [-1, 1] and of rewards; truths relative to
    their range.
    """
    played = play_ours(dataclasses.replace(static, reward=REWARDS[0]), params, seed, steps)
    env = StoneSoupEnv(static, params, np.float64, exact_jacobian=True)
    env.reset(options={"draws": draws_of(played, params)})
    for k in range(steps):
        observation, reward, *_ = env.step(played.actions[k])
        divergence = compare_truths(played, k, env.scenario, tallies.truths)
        ours = {name: values[k] for name, values in played.observations.items()}
        pairs = {name: (ours[name], observation[name]) for name in ours}
        pairs["reward"] = (played.rewards[static.reward][k], np.asarray(reward))
        for name, (mine, theirs) in pairs.items():
            errors = np.abs(np.asarray(mine, float) - theirs)
            tallies.seen.error(float(errors.max()))
            if divergence is None and not errors.max() <= tolerance:
                worst = tuple(int(i) for i in np.unravel_index(np.argmax(errors), errors.shape))
                divergence = Divergence(k + 1, None, f"{name}{list(worst)}", mine[worst], theirs[worst])
        tallies.seen.decision(divergence is None)
        if divergence is not None:
            return divergence
    return None


def compare_truths(played: Played, k: int, scenario: StoneSoupScenario, tally: Tally) -> Divergence | None:
    """The living truths of one step, row by row."""
    theirs = {scenario.row_of[path]: as_vector(path[-1].state_vector) for path in scenario.paths}
    alive = {int(row) for row in np.flatnonzero(played.truths.alive[k])}
    tally.decision(alive == theirs.keys())
    for row in alive & theirs.keys():
        gap = np.abs(np.asarray(played.truths.state[k, row]) - theirs[row])
        tally.error(float(gap.max() / np.linalg.norm(theirs[row][0::2])))
    if alive != theirs.keys():
        return Divergence(k + 1, None, "living truths", sorted(alive), sorted(theirs))
    return None
