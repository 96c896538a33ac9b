"""The environment `SearchTrack-v0` in gymnax form. It holds no mathematics of its own."""

import dataclasses
from functools import partial
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
from gymnax.environments import environment

from jaxtrack import metrics, spaces, tracker
from jaxtrack.episode import EnvState, StepNoise, StepRecord, sample_step_noise
from jaxtrack.kernel import Function, one_by_one, rarely
from jaxtrack.lifecycle import no_tracks
from jaxtrack.observation import TRACK_FEATURES, Observation, observe
from jaxtrack.params import Params, StaticParams
from jaxtrack.reward import reward_terms
from jaxtrack.sampling import split
from jaxtrack.scan_map import initial_scan_map, mean_scan_value, update_scan_map
from jaxtrack.sensor import detect, look_angles
from jaxtrack.truth import initiate_truths, propagate_truths
from jaxtrack.validation import check_trajectories, validate

ENV_ID = "SearchTrack-v0"

ALWAYS_IN_INFO = ("completeness", "covariance_norm_sum", "covariance_norm_mean")
"""Metrics that are cheap enough for every step."""

LARGEST_IN_ONE_KERNEL = {"max_tracks": 200, "num_truths": 100, "max_detections": 50, "max_clutter": 50}
"""Larger scenarios are stepped all at once: XLA spreads their arrays over threads, one kernel can not."""


def one_by_one_if_small(function: Function, static: StaticParams) -> Function:
    """`one_by_one`, unless the scenario is larger than `LARGEST_IN_ONE_KERNEL`: then `function` as it is."""
    fits = all(getattr(static, name) <= largest for name, largest in LARGEST_IN_ONE_KERNEL.items())
    return one_by_one(function) if fits else function


class SearchTrack(environment.Environment[EnvState, Params]):
    """Search and track with a steerable radar (paper, section III).

    Observation, action, reward and termination: see `jaxtrack/README.md`.
    """

    def __init__(self, static: StaticParams | None = None, **shapes: Any) -> None:
        """Takes the shapes as a `StaticParams`, as keywords, or both.

        Raises:
            ValueError: naming the field, if a shape makes no sense.
            TypeError: if a keyword is no field of `StaticParams`.
        """
        base = static or StaticParams()
        self.static = StaticParams(**{**vars(base), **shapes})

    @property
    def name(self) -> str:
        """Registered name."""
        return ENV_ID

    @property
    def default_params(self) -> Params:
        """The scenario of the paper."""
        return Params()

    @property
    def num_actions(self) -> int:
        """Number of discrete looks."""
        return self.static.num_looks**2

    @partial(jax.jit, static_argnames=("self",))
    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params | None = None
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """`step_env`, and a new episode where one ended: gymnax's `step`, which makes one at every step."""
        params = self.default_params if params is None else params
        key_step, key_reset = split(key)
        last, moved, reward, terminated, info = self.step_env(key_step, state, action, params)
        truncated = self.is_truncated(moved, params)
        done = terminated | truncated
        # Never true, but once the reward is known nothing reads the old map: a CPU need not copy it.
        renewed = done | (reward < -jnp.inf)
        state = rarely(renewed, self._begin, (key_reset, params), moved)
        # Twice the same as long as no episode ends; but then mostly nobody asks for the final one.
        observation = self.observe(key_step, state, action, params)
        ended = {"terminated": terminated, "truncated": truncated, "final_observation": last}
        return observation, state, reward, terminated, truncated, {**info, **ended}

    def reset_env(self, key: jax.Array, params: Params) -> tuple[Observation, EnvState]:
        """New truths, no tracks, a field never seen."""
        check_trajectories(self.static, params)
        state = self._begin(key, params)
        return self.observe(key, state, None, params), state

    def _begin(self, key: jax.Array, params: Params) -> EnvState:
        truths = initiate_truths(key, self.static, params)
        return EnvState(
            time=jnp.asarray(0, dtype=int),
            truths=truths,
            tracks=no_tracks(self.static.max_tracks, self.static),
            scan_map=initial_scan_map(self.static),
            num_born=jnp.sum(truths.alive),
            num_initiated=jnp.asarray(0, dtype=int),
        )

    def step_env(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, dict[str, jax.Array]]:
        """One step: observation, state, reward, terminated, info."""
        before = state
        state, record = self.play(key, state, action, params)
        terms = reward_terms(before.tracks, state.tracks, state.truths, state.scan_map, self.static, params)
        info = step_info(state, record, terms, self.static, params)
        observation = self.observe(key, state, action, params)
        return observation, state, terms[0] + terms[1], self.is_terminated(state, params), info

    def play(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[EnvState, StepRecord]:
        """`advance` with noise from the key, fast for many scenarios; the record lacks the `tracker`."""
        # The map is the same work for all and the larger part of the state: it stays outside.
        without_map = state.replace(scan_map=None)
        moved, record = one_by_one_if_small(self._draw_and_track, self.static)(
            key, without_map, action, params
        )
        scan_map = update_scan_map(state.scan_map, record.look, self.static, params)
        return moved.replace(scan_map=scan_map), record

    def advance(
        self, state: EnvState, action: jax.Array, noise: StepNoise, params: Params
    ) -> tuple[EnvState, StepRecord]:
        """The deterministic core: truths move, the radar looks, the tracker runs."""
        moved, record = self._look_and_track(state, action, noise, params)
        scan_map = update_scan_map(state.scan_map, record.look, self.static, params)
        return moved.replace(scan_map=scan_map), record

    def _draw_and_track(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: Params
    ) -> tuple[EnvState, StepRecord]:
        state, record = self._look_and_track(state, action, self.sample_noise(key), params)
        return state, record.replace(tracker=None)

    def _look_and_track(
        self, state: EnvState, action: jax.Array, noise: StepNoise, params: Params
    ) -> tuple[EnvState, StepRecord]:
        """All of a step but the scan map."""
        if jnp.shape(action) != (2,):
            raise ValueError(f"action has shape {jnp.shape(action)}: expected (2,), azimuth and elevation")
        time = state.time + 1
        truths, num_born, rowless = propagate_truths(state.truths, state.num_born, noise.truths, time, params)
        look = look_angles(action, self.static, params)
        detections, num_dropped = detect(truths, look, noise.sensor, self.static, params)
        tracks, info = tracker.step(state.tracks, detections, params.time_step, time, params, self.static)
        num_initiated = state.num_initiated + jnp.sum(info.initiated)
        state = EnvState(time, truths, tracks, state.scan_map, num_born, num_initiated)
        return state, StepRecord(look, detections, rowless, num_dropped, info.num_dropped, info)

    def sample_noise(self, key: jax.Array) -> StepNoise:
        """Draws all that is random in one step; the key is consumed."""
        return sample_step_noise(key, self.static)

    def observe(
        self, key: jax.Array, state: EnvState, action: jax.Array | None, params: Params
    ) -> Observation:
        """Track list, mask and scan map; deterministic."""
        del key, action
        return observe(state.tracks, state.scan_map, params, self.static.observe_variances)

    def is_terminated(self, state: EnvState, params: Params) -> jax.Array:
        """Whether the stop metric exceeds its threshold; without one, never."""
        if self.static.stop_metric is None or params.stop_threshold is None:
            return jnp.asarray(False)
        value = metrics.METRICS[self.static.stop_metric](state.truths, state.tracks, params)
        return value > params.stop_threshold

    def action_space(self, params: Params) -> spaces.Box | spaces.Indices:
        """Two integers in [0, num_looks), or two angles in rad."""
        if self.static.continuous_actions:
            return spaces.Box(-params.field_limit, params.field_limit, (2,), jnp.float32)
        return spaces.Indices(self.static.num_looks, (2,))

    def observation_space(self, params: Params) -> spaces.Dict:
        """Dictionary of track features, mask and scan map, and of the variances if there are any."""
        del params
        tracks, pixels = self.static.max_tracks, self.static.map_size
        boxes = {
            "tracks": spaces.Box(-jnp.inf, jnp.inf, (tracks, TRACK_FEATURES), jnp.float32),
            "mask": spaces.Box(0, 1, (tracks,), jnp.bool_),
            "scan_map": spaces.Box(0.0, 1.0, (pixels, pixels), jnp.float32),
        }
        if self.static.observe_variances:
            boxes["variances"] = spaces.Box(0.0, jnp.inf, (tracks, 2), jnp.float32)
        return spaces.Dict(boxes)


def step_info(
    state: EnvState,
    record: StepRecord,
    terms: tuple[jax.Array, jax.Array],
    static: StaticParams,
    params: Params,
) -> dict[str, jax.Array]:
    """What a user wants to log of one step; every entry is a scalar."""
    asked = {name: metrics.METRICS[name] for name in (*ALWAYS_IN_INFO, *static.info_metrics)}
    return {
        **{name: metric(state.truths, state.tracks, params) for name, metric in asked.items()},
        "live_tracks": jnp.sum(state.tracks.active),
        "mean_scan_value": mean_scan_value(state.scan_map),
        "reward_track": terms[0],
        "reward_search": terms[1],
        "num_detections": jnp.sum(record.detections.active),
        "dropped_truths": record.num_dropped_truths,
        "dropped_detections": record.num_dropped_detections,
        "dropped_tracks": record.num_dropped_tracks,
    }


def make(
    params: Params | None = None, static: StaticParams | None = None, **fields: Any
) -> tuple[SearchTrack, Params]:
    """The environment and its parameters, both checked.

    Args:
        params: numbers; the paper's scenario by default.
        static: shapes; the paper's by default.
        **fields: any field of `Params` or `StaticParams`, to change just that.

    Raises:
        ValueError: naming the wrong field and its range, or a field that does not exist.
    """
    for name, value, kind in (("params", params, Params), ("static", static, StaticParams)):
        if value is not None and not isinstance(value, kind):
            raise ValueError(f"{name} = {value!r}: expected a {kind.__name__}")
    numbers = {field.name for field in dataclasses.fields(Params)}
    shapes = {field.name for field in dataclasses.fields(StaticParams)}
    unknown = sorted(set(fields) - numbers - shapes)
    if unknown:
        raise ValueError(
            f"{unknown[0]}: no such field; expected one of {', '.join(sorted(numbers | shapes))}"
        )
    params = dataclasses.replace(
        params or Params(), **{name: value for name, value in fields.items() if name in numbers}
    )
    env = SearchTrack(static, **{name: value for name, value in fields.items() if name in shapes})
    validate(env.static, params)
    return env, params


gymnax.register(ENV_ID, SearchTrack)
