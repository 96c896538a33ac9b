"""Plays policies on the same scenarios, in chunks of episodes, as one compiled program."""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import cores
from jaxtrack.env import SearchTrack
from jaxtrack.episode import EnvState
from jaxtrack.params import Params
from jaxtrack.policies import Policy, PolicyBuilder
from train.episode_metrics import CURVES, METRICS, StepRow, episode_curves, episode_values, step_row
from train.prepared import Kept, Prepared, prepare

MEMORY = 105e6
"""Bytes that the record of a chunk may take. The same on every machine, because rounding differs with
the size of a chunk, and a policy that meets a tie may then take another look."""
MOST_WORKERS = 8
"""Chunks that are played at the same time, at most."""
BYTES_PER_PAIR = 32
"""What a step of a chunk takes per pair of truth and track slot."""


@dataclasses.dataclass(frozen=True)
class Competitor:
    """A policy, trained once for every seed or not at all.

    Attributes:
        build: weights to the policy's builder.
        weights: one per training seed; a policy that is not trained has one, of no use.
        seeds: the training seeds; none for a policy that is not trained.
    """

    build: Callable[[Any], PolicyBuilder]
    weights: Sequence[Any] = ((),)
    seeds: tuple[int, ...] = ()


def rule(builder: PolicyBuilder) -> Competitor:
    """A policy that is not trained."""
    return Competitor(lambda weights: builder)


@dataclasses.dataclass(frozen=True)
class Curve:
    """Mean `[K]` of a value over the episodes that have it, and its 95 % band (two standard errors)."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclasses.dataclass(frozen=True)
class Played:
    """What is known of a policy after E episodes with each of S training seeds.

    Attributes:
        seeds: the training seeds; none if it was not trained.
        values: `[S, E]` by metric; NaN where an episode does not define it.
        curves: by name.
        looks: `[L, L]` share of the dwells at azimuth index i and elevation index j.
    """

    seeds: tuple[int, ...]
    values: dict[str, np.ndarray]
    curves: dict[str, Curve]
    looks: np.ndarray


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Policies by name, and how long they took (s)."""

    played: dict[str, Played]
    compile_seconds: float
    play_seconds: float


def play_episodes(
    keys: jax.Array, act: Policy, env: SearchTrack, params: Params, length: int
) -> tuple[dict[str, jax.Array], dict[str, jax.Array], jax.Array]:
    """Plays a policy on the scenarios of `keys` `[E]`.

    The scenario (truths and all noise) follows from the key alone, so that every policy meets
    the same ones. Episodes are played to their full length, whatever `stop_metric` says.

    Returns:
        Metrics `[E]`, curves `[E, K]`, and the number of every look `[E, K]`.
    """

    def episode(key: jax.Array) -> tuple[dict[str, jax.Array], dict[str, jax.Array], jax.Array]:
        key_reset, key_noise, key_policy = jax.random.split(key, 3)
        _, start = env.reset_env(key_reset, params)

        def one_step(state: EnvState, key: jax.Array) -> tuple[EnvState, StepRow]:
            action = act(key_policy, state)
            after, record = env.play(key, state, action, params)
            return after, step_row(state, after, record, env, params)

        rows = jax.lax.scan(one_step, start, jax.random.split(key_noise, length))[1]
        return episode_values(rows, params), episode_curves(rows.values), rows.look

    return jax.vmap(episode)(keys)


def compare(
    competitors: Mapping[str, Competitor],
    env: SearchTrack,
    params: Params,
    episodes: int,
    seed: int,
    advance: Callable[[int], None] = lambda number: None,
) -> Comparison:
    """Plays every competitor on the same scenarios; compiles once for all of them.

    Args:
        competitors: by the name they get in the table.
        env: the environment.
        params: its numbers.
        episodes: number of scenarios.
        seed: of the scenarios.
        advance: told the number of episodes that were just played.
    """
    length = int(params.max_steps_in_episode)
    chunks = list(split(jax.random.split(jax.random.key(seed), episodes), env, length))
    started = time.perf_counter()
    prepared = [prepare(one.build, one.weights[0], env, params) for one in competitors.values()]
    kept = [
        [one.work_out(weights, params) for weights in competitor.weights]
        for one, competitor in zip(prepared, competitors.values(), strict=True)
    ]
    firsts = [own[0] for own in kept]
    program = compile_program(prepared, firsts, env, params, length, chunks[0][0])
    compiled = time.perf_counter()
    rounds = [(which, own) for which, seeds in enumerate(kept) for own in seeds]

    def play(task: tuple[tuple[int, Kept], tuple[jax.Array, int]]) -> Any:
        (which, own), (keys, number) = task
        everyones = [own if i == which else first for i, first in enumerate(firsts)]
        chunk = jax.device_get(program(keys, jnp.asarray(which), everyones, params))
        return which, number, jax.tree.map(lambda leaf: leaf[:number], chunk)

    sums = [Sums(length, env.static.num_looks) for _ in competitors]
    pool = ThreadPoolExecutor(workers())
    try:
        for which, number, chunk in pool.map(play, itertools.product(rounds, chunks)):
            sums[which].add(*chunk)
            advance(number)
    finally:
        pool.shutdown(cancel_futures=True)
    played = {
        name: own.result(one.seeds, len(one.weights))
        for own, (name, one) in zip(sums, competitors.items(), strict=True)
    }
    return Comparison(played, compiled - started, time.perf_counter() - compiled)


def workers() -> int:
    """Chunks that are played at the same time: XLA takes little more than one core for one."""
    if jax.default_backend() != "cpu":
        return 1
    return min(cores.available(), MOST_WORKERS)


def compile_program(
    prepared: Sequence[Prepared],
    everyones: list[Kept],
    env: SearchTrack,
    params: Params,
    length: int,
    keys: jax.Array,
) -> Any:
    """The compiled program: keys, number of the competitor, what everyone keeps, params to a chunk."""

    def play(keys: jax.Array, which: jax.Array, everyones: list[Kept], params: Params) -> Any:
        policies = [one.policy(own) for one, own in zip(prepared, everyones, strict=True)]

        def act(key: jax.Array, state: EnvState) -> jax.Array:
            return jax.lax.switch(which, policies, key, state)

        return play_episodes(keys, act, env, params, length)

    return jax.jit(play).lower(keys, jnp.asarray(0), everyones, params).compile()


def split(keys: jax.Array, env: SearchTrack, length: int) -> Iterator[tuple[jax.Array, int]]:
    """Chunks of keys of one size, and how many of each count: the last one may be padded."""
    per_episode = BYTES_PER_PAIR * length * env.static.num_truths * env.static.max_tracks
    largest = max(1, int(MEMORY / per_episode))
    size = math.ceil(len(keys) / math.ceil(len(keys) / largest))
    for start in range(0, len(keys), size):
        place = np.arange(start, start + size)
        yield keys[np.minimum(place, len(keys) - 1)], int(np.sum(place < len(keys)))


class Sums:
    """Gathers the chunks of one policy: metrics as they are, curves and looks as sums.

    Args:
        length: steps K of an episode.
        num_looks: looks L along each axis.
    """

    def __init__(self, length: int, num_looks: int) -> None:
        self.values: dict[str, list[np.ndarray]] = {name: [] for name in METRICS}
        self.moments = {name: np.zeros((3, length)) for name in CURVES}
        self.looks = np.zeros(num_looks**2, dtype=int)

    def add(self, values: dict[str, np.ndarray], curves: dict[str, np.ndarray], looks: np.ndarray) -> None:
        """Takes a chunk: metrics `[E]`, curves `[E, K]`, numbers of looks `[E, K]`."""
        for name, value in values.items():
            self.values[name].append(np.asarray(value, dtype=float))
        for name, curve in curves.items():
            known = np.isfinite(curve)
            curve = np.where(known, curve, 0.0).astype(float)
            self.moments[name] += np.stack([known.sum(axis=0), curve.sum(axis=0), (curve**2).sum(axis=0)])
        self.looks += np.bincount(looks.ravel(), minlength=self.looks.size)

    def result(self, seeds: tuple[int, ...], rows: int) -> Played:
        """All that was gathered; the metrics of `rows` training seeds one after another."""
        num_looks = math.isqrt(self.looks.size)
        return Played(
            seeds=seeds,
            values={name: np.concatenate(found).reshape(rows, -1) for name, found in self.values.items()},
            curves={name: _curve(*moments) for name, moments in self.moments.items()},
            looks=(self.looks / self.looks.sum()).reshape(num_looks, num_looks),
        )


def _curve(number: np.ndarray, total: np.ndarray, squares: np.ndarray) -> Curve:
    """Mean and band `[K]` from number of values, sum, and sum of squares; NaN where too few."""
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total / number
        variance = np.maximum(squares - number * mean**2, 0.0) / (number - 1)
        half = np.where(number > 1, 1.96 * np.sqrt(np.maximum(variance, 0.0) / number), np.nan)
    return Curve(mean, mean - half, mean + half)
