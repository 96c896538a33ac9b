"""Whatever is put in, from Python: an error that names it, or numbers that stay finite."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxtrack
from jaxtrack import Params, StaticParams
from jaxtrack.params import METRICS, REWARDS

pytestmark = pytest.mark.usefixtures("quick_compilation")

FIELDS = [*dataclasses.fields(Params), *dataclasses.fields(StaticParams)]
# A number that may be unset is for a part of the tracker that is not here.
QUANTITIES = [
    field for field in dataclasses.fields(Params) if "low" in field.metadata and field.default is not None
]
SMALL = {
    "num_truths": 4,
    "max_tracks": 6,
    "max_detections": 4,
    "max_clutter": 2,
    "map_size": 12,
    "num_looks": 5,
}
STEPS = 20
# Everything happens: wide beam, false detections, manoeuvres, births, deaths, the end of an episode.
BUSY = Params(
    time_step=0.05,
    clutter_rate=0.5,
    beam_azimuth=0.6,
    beam_elevation=0.6,
    truth_turn_rate=0.5,
    truth_acceleration=5.0,
    initial_truths=2,
    birth_rate=0.05,
    death_probability=0.02,
    max_steps_in_episode=12,
)

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(10**400), 10**400),
    st.floats(),
    st.complex_numbers(),
    st.text(max_size=5),
    st.binary(max_size=5),
    st.dates(),
    st.just(object),
)
junk = st.one_of(
    scalars,
    st.lists(scalars, max_size=3),
    st.lists(scalars, max_size=3).map(tuple),
    st.dictionaries(st.text(max_size=3), scalars, max_size=2),
    st.lists(st.floats(), max_size=3).map(np.array),
    st.lists(scalars, max_size=3).map(lambda values: np.array([None, *values], dtype=object)),
)


@given(st.sampled_from(FIELDS), junk)
def test_junk_in_a_field_is_refused_by_name_or_works(field, value):
    try:
        _, params = jaxtrack.make(**{field.name: value})
    except ValueError as error:
        message = str(error)
        # What one field may be can depend on another.
        assert message.startswith((field.name, "min_range", "clutter_rate", "stop_threshold")), message
        assert "expected" in message
    else:
        jax.tree.map(lambda leaf: np.testing.assert_array_less(np.abs(leaf), np.inf), params)


@pytest.mark.parametrize("fields", [{"params": 5}, {"static": Params()}, {"params": StaticParams()}])
def test_records_of_another_kind_are_refused(fields):
    name = next(iter(fields))
    with pytest.raises(ValueError, match=rf"^{name} = .*: expected a (Params|StaticParams)$"):
        jaxtrack.make(**fields)


@pytest.mark.parametrize("value", [[1.0, 2.0], np.array([]), True, "5", 10**400, 2.5])
def test_what_only_looks_like_a_number_of_steps_is_refused(value):
    with pytest.raises(
        ValueError, match=r"^max_steps_in_episode = .*expected a whole number in \[1, 1e\+09\]"
    ):
        jaxtrack.make(max_steps_in_episode=value)


@pytest.mark.parametrize(
    "recorded", [np.full((2, 4, 6), np.inf), np.full((2, 4, 6), 1e30), np.full((2, 4, 6), "far")]
)
def test_recordings_hold_numbers_or_nan(recorded):
    with pytest.raises(ValueError, match=r"^trajectories: expected numbers in \[-1e\+09, 1e\+09\]"):
        jaxtrack.make(trajectories=recorded, num_truths=4)
    jaxtrack.make(trajectories=np.full((2, 4, 6), np.nan), num_truths=4)


def edges():
    """The scenario with each number in turn at the ends of its range, and where things degenerate."""
    cases = {"as it is": BUSY}
    for field in QUANTITIES:
        low, high = field.metadata["low"], field.metadata["high"]
        for value in {low + 1e-30 if field.metadata["open_low"] else low, high, 1e-9, 1e-3, 1.0, 1e3, 1e6}:
            if low <= value <= high and not (field.metadata["unit"] == "steps" and value < 1):
                cases[f"{field.name} = {value:g}"] = fitting(BUSY.replace(**{field.name: value}), field.name)
    cases["zero truths"] = BUSY.replace(initial_truths=0, birth_rate=0.0)
    tiny = {"elevation_sigma": 1e-30, "bearing_sigma": 1e-30, "range_sigma": 1e-30}
    cases["no noise"] = BUSY.replace(**tiny, truth_process_noise=0.0, process_noise=0.0)
    return cases


def fitting(params, name):
    """Other numbers moved where they depend on the one by name."""
    low, high = float(params.min_range), float(params.max_range)
    other = {"min_range": {"max_range": max(low, high)}, "max_range": {"min_range": min(low, high)}}
    other["time_step"] = {"truth_acceleration": 0.0}  # for days it leads beyond float32
    return params.replace(**other.get(name, {}), clutter_rate=min(float(params.clutter_rate), 2.0))


def play(env, params, keys):
    """All that an agent or a log gets to see in `STEPS` random looks, and which tracks live."""

    def one(state, key):
        action = jax.random.randint(key, (2,), 0, SMALL["num_looks"])
        observation, state, reward, _, _, info = env.step(key, state, action, params)
        return state, (observation, reward, info, state.truths)

    _, state = env.reset(keys[0], params)
    return jax.lax.scan(one, state, keys)[1]


slow = [pytest.param(name, marks=pytest.mark.slow) for name in REWARDS if name not in ("paper", "gospa")]


@pytest.mark.parametrize("reward", ["paper", "gospa", *slow])
def test_numbers_at_the_ends_of_their_ranges_leave_nothing_that_is_not_finite(reward):
    cases = edges()
    for params in cases.values():
        jaxtrack.validate(StaticParams(**SMALL), params)
    shapes = SMALL | {"reward": reward, "info_metrics": METRICS, "observe_variances": True}
    env = jaxtrack.SearchTrack(**shapes)
    batch = jax.tree.map(lambda *leaves: jnp.array(leaves, dtype=float), *cases.values())
    keys = jax.random.split(jax.random.key(0), STEPS)
    seen = jax.jit(jax.vmap(lambda params: play(env, params, keys)))(batch)
    finite = jnp.stack(
        [jnp.isfinite(leaf).reshape(len(cases), -1).all(axis=1) for leaf in jax.tree.leaves(seen)]
    )
    assert [name for name, fine in zip(cases, finite.all(axis=0), strict=True) if not fine] == []


@pytest.fixture(scope="module", params=[False, True], ids=["discrete", "continuous"])
def game(request):
    """An environment with a compiled step, and a state with a track straight ahead."""
    recorded = np.zeros((30, 4, 6))
    recorded[:, :, 0] = [3000.0, 4000.0, 0.0, np.nan]  # the third sits in the sensor, the fourth is absent
    env, params = jaxtrack.make(
        **SMALL, trajectories=recorded, continuous_actions=request.param, max_steps_in_episode=1000
    )
    ahead = jnp.zeros(2) if request.param else jnp.array([2, 2])
    _, state = env.reset(jax.random.key(0), params)
    for _ in range(3):
        _, state, *_ = env.step(jax.random.key(1), state, ahead, params)
    return env, params, state


angles = st.one_of(st.floats(width=32), st.integers(-(2**31), 2**31 - 1).map(float))


@given(st.tuples(angles, angles))
def test_any_action_leaves_finite_numbers(game, action):
    env, params, state = game
    observation, after, reward, *_, info = env.step(
        jax.random.key(2), state, jnp.array(action, jnp.float32), params
    )
    info.pop("final_observation")
    for leaf in jax.tree.leaves((observation, reward, info)):
        assert np.all(np.isfinite(leaf))
    assert int(after.time) == int(state.time) + 1
    # One that is in no field at all sees nothing: neither detections nor a fresh place on the map.
    if any(math.isnan(value) for value in action):
        assert int(info["num_detections"]) == 0
        assert np.all(after.scan_map >= state.scan_map)


@given(st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 2))
def test_a_look_beyond_the_field_is_the_one_at_its_edge(game, action):
    env, params, state = game
    if env.static.continuous_actions:
        beyond = jnp.array(action, dtype=float)
        edge = jnp.clip(beyond, -params.field_limit, params.field_limit)
    else:
        beyond = jnp.array(action)
        edge = jnp.clip(beyond, 0, SMALL["num_looks"] - 1)
    maps = [env.step(jax.random.key(2), state, each, params)[0]["scan_map"] for each in (beyond, edge)]
    np.testing.assert_array_equal(*maps)


@pytest.mark.parametrize("action", [5, [5], [1, 2, 3], [[1, 2]]])
def test_an_action_of_another_shape_is_refused(game, action):
    env, params, state = game
    with pytest.raises(ValueError, match=r"^action has shape .*: expected \(2,\), azimuth and elevation"):
        env.step(jax.random.key(2), state, jnp.array(action, dtype=float), params)


def test_a_target_in_the_sensor_is_no_trouble(game):
    _, _, state = game
    assert int(jnp.sum(state.truths.alive)) == 3
    assert np.all(np.isfinite(state.tracks.mean))
    assert int(jnp.sum(state.tracks.active)) >= 2
