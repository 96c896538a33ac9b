"""Truths: where they are born, how they move, and how recordings are replayed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams, Truths
from jaxtrack.episode import sample_step_noise
from jaxtrack.models import constant_velocity, spherical
from jaxtrack.truth import (
    TruthNoise,
    begin_truths,
    initiate_truths,
    move_truths,
    process_noise_factor,
    propagate_truths,
)
from jaxtrack.types import position, velocity

pytestmark = pytest.mark.usefixtures("quick_compilation")

MANY = StaticParams(num_truths=4000)
initiate = jax.jit(initiate_truths, static_argnums=1)
propagate = jax.jit(propagate_truths)
move = jax.jit(move_truths)


def draws(rows, motion=0.0, death=0.5, birth_count=0.5):
    """Noise of one step in which every row draws the same, unless arrays are given."""
    return TruthNoise(
        motion=jnp.broadcast_to(motion, (rows, 3, 2)).astype(float),
        death=jnp.broadcast_to(death, (rows,)).astype(float),
        birth_count=jnp.asarray(birth_count, dtype=float),
    )


@pytest.fixture(scope="module")
def born(params):
    return initiate(jax.random.key(0), MANY, params)


def test_all_truths_are_born_alive_within_the_field(born, params):
    elevation, azimuth, distance = np.moveaxis(np.asarray(spherical(position(born.state))), -1, 0)
    assert bool(jnp.all(born.alive))
    for angle in (azimuth, elevation):
        assert np.all(np.abs(angle) <= params.field_limit * (1 + 1e-6))
        # Uniform on (-limit, limit): mean 0, standard deviation limit/sqrt(3); 5 standard errors.
        assert abs(angle.mean()) < 5 * params.field_limit / np.sqrt(3 * MANY.num_truths)
        np.testing.assert_allclose(angle.std(), params.field_limit / np.sqrt(3), rtol=0.05)
    assert np.all((distance > params.min_range * 0.999) & (distance < params.max_range * 1.001))
    np.testing.assert_allclose(distance.mean(), (params.min_range + params.max_range) / 2, rtol=0.05)
    assert abs(np.corrcoef(azimuth, elevation)[0, 1]) < 5 / np.sqrt(MANY.num_truths)


def test_initial_velocities_are_normal_on_each_axis(born, params):
    covariance = np.cov(np.asarray(velocity(born.state)).T)
    np.testing.assert_allclose(covariance / params.truth_velocity_sigma**2, np.eye(3), atol=0.12)


def test_equal_keys_give_equal_truths_and_others_do_not(static, params):
    first, again, other = (initiate(jax.random.key(seed), static, params) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.state, again.state)
    assert not np.any(np.asarray(first.state) == np.asarray(other.state))


def test_the_noise_factor_is_the_root_of_one_axis_of_Q(x64):
    _, Q = constant_velocity(0.3, 2.0)
    factor = process_noise_factor(0.3, 2.0)
    np.testing.assert_allclose(factor @ factor.T, Q[:2, :2], rtol=1e-13)


def test_the_spread_of_moving_truths_is_Q():
    count, params = MANY.num_truths, Params(time_step=0.5, truth_process_noise=3.0)
    truths = Truths(state=jnp.zeros((count, 6)), alive=jnp.ones(count, dtype=bool))
    noise = jax.random.normal(jax.random.key(3), (count, 3, 2))
    moved = move(truths, noise, params)
    _, Q = constant_velocity(0.5, 3.0)
    scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
    # A sample correlation of n draws has a standard error of at most sqrt(2/n) = 0.022.
    np.testing.assert_allclose(np.cov(np.asarray(moved.state).T) / scale, Q / scale, atol=0.11)


def test_without_process_noise_truths_fly_exactly_straight():
    params = Params(time_step=0.5, truth_process_noise=0.0)
    truths = Truths(state=jnp.array([[1000.0, 8, -200, -4, 50, 2]]), alive=jnp.ones(1, dtype=bool))
    for _ in range(4):
        truths = move(truths, jnp.ones((1, 3, 2)), params)
    # Four steps of half a second.
    np.testing.assert_array_equal(truths.state, [[1016.0, 8, -208, -4, 54, 2]])


def test_motion_is_linear_in_the_noise_of_its_own_truth_and_axis(static):
    params = Params(time_step=0.5, truth_process_noise=3.0)
    truths = Truths(state=jnp.zeros((3, 6)), alive=jnp.ones(3, dtype=bool))
    noise = jnp.zeros((3, 3, 2)).at[1, 2].set(jnp.array([1.0, -2.0]))
    moved = np.asarray(move(truths, noise, params).state)
    expected = np.linalg.cholesky(np.asarray(constant_velocity(0.5, 3.0)[1][:2, :2])) @ [1.0, -2.0]
    np.testing.assert_allclose(moved[1, 4:6], expected, rtol=1e-5)
    assert np.count_nonzero(moved) == 2


@pytest.fixture(scope="module")
def recording():
    recorded = np.arange(36, dtype=float).reshape(2, 3, 6)
    recorded[0, 1, 4] = np.nan
    recorded[1, 2] = np.nan
    return recorded


def test_recordings_replace_birth_and_motion(recording, static):
    params = Params(trajectories=jnp.asarray(recording))
    truths = initiate(jax.random.key(0), static, params)
    np.testing.assert_array_equal(truths.alive, [True, False, True])
    np.testing.assert_array_equal(truths.state[0], recording[0, 0])
    np.testing.assert_array_equal(truths.state[1], np.zeros(6))
    truths, _, _ = propagate(truths, jnp.asarray(2), draws(3, motion=1.0), 1, params)
    np.testing.assert_array_equal(truths.alive, [True, True, False])
    np.testing.assert_array_equal(truths.state[:2], recording[1, :2])


def test_the_last_row_stays_after_the_end_of_a_recording(recording, static):
    params = Params(trajectories=jnp.asarray(recording))
    truths = initiate(jax.random.key(0), static, params)
    after, _, _ = propagate(truths, jnp.asarray(2), draws(3), 7, params)
    np.testing.assert_array_equal(after.state[:2], recording[1, :2])
    np.testing.assert_array_equal(after.alive, [True, True, False])


def test_only_the_first_truths_are_alive_at_the_start(static):
    truths = initiate(jax.random.key(0), static, Params(initial_truths=2))
    np.testing.assert_array_equal(truths.alive, [True, True, False])


def test_deaths_come_before_and_births_after_motion():
    """Row 0 dies, row 1 lives and moves, row 2 is born and has not moved; row 3 stays unused."""
    params = Params(time_step=1.0, truth_process_noise=0.0, death_probability=0.2, birth_rate=1.0)
    state = jnp.zeros((4, 6)).at[:, 0].set(2000.0).at[:, 1].set(10.0)
    truths = Truths(state=state, alive=jnp.arange(4) < 2)
    # P(0 births) = 0.37 and P(at most 1) = 0.74 at rate 1.
    # The newborn has a velocity, with which it must not have moved yet.
    motion = jnp.zeros((4, 3, 2)).at[2, :, 1].set(1.0)
    noise = draws(4, motion, death=jnp.array([0.1, 0.2, 0.0, 0.0]), birth_count=0.5)
    after, num_born, rowless = propagate(truths, jnp.asarray(2), noise, 1, params)
    np.testing.assert_array_equal(after.alive, [False, True, True, False])
    assert (int(num_born), int(rowless)) == (3, 0)
    assert float(after.state[1, 0]) == 2010.0
    # Draws of zero are the middle of the field.
    middle, speed = (params.min_range + params.max_range) / 2, params.truth_velocity_sigma
    np.testing.assert_allclose(after.state[2], [middle, speed, 0, speed, 0, speed], atol=1e-3)


def test_the_row_of_a_dead_truth_is_not_used_again():
    params = Params(birth_rate=1.0)
    truths = Truths(state=jnp.zeros((3, 6)), alive=jnp.array([False, True, True]))
    after, num_born, rowless = propagate(truths, jnp.asarray(3), draws(3, birth_count=0.9), 1, params)
    np.testing.assert_array_equal(after.alive, truths.alive)
    # Two births that found no row.
    assert (int(num_born), int(rowless)) == (5, 2)


def test_more_births_than_rows_are_all_counted():
    crowd, nobody = Params(birth_rate=6.0), Truths(state=jnp.zeros((3, 6)), alive=jnp.zeros(3, dtype=bool))
    after, num_born, rowless = propagate(nobody, jnp.asarray(1), draws(3, birth_count=0.9), 1, crowd)
    np.testing.assert_array_equal(after.alive, [False, True, True])
    assert (int(num_born), int(rowless)) == (10, 7)  # P(at most 8) = 0.85, P(at most 9) = 0.92 at rate 6


def test_no_draw_serves_twice():
    noise = sample_step_noise(jax.random.key(0), StaticParams(num_truths=50)).truths
    uniform = np.append(noise.death, noise.birth_count)
    assert len(np.unique(uniform)) == 51
    assert len(np.unique(noise.motion)) == 300


def test_births_and_deaths_are_as_frequent_as_asked():
    params = Params(birth_rate=0.7, death_probability=0.1, initial_truths=3000)
    truths = initiate(jax.random.key(0), MANY, params)
    keys = jax.random.split(jax.random.key(1), 200)

    def step(carry, key):
        noise = sample_step_noise(key, MANY).truths
        truths, num_born, _ = propagate_truths(*carry, noise, 1, params)
        return (truths, num_born), (jnp.sum(carry[0].alive), jnp.sum(truths.alive), num_born)

    before, after, num_born = jax.jit(lambda: jax.lax.scan(step, (truths, 3000), keys)[1])()
    births = np.diff(num_born, prepend=3000)
    deaths = before + births - after
    assert abs(births.mean() - 0.7) < 4 * np.sqrt(0.7 / 200)
    assert abs(deaths.sum() / before.sum() - 0.1) < 4 * np.sqrt(0.09 / before.sum())


def test_newborns_are_placed_as_at_the_start(born, params):
    """The same law through the normal draws of motion."""
    crowd = params.replace(birth_rate=80.0)
    nobody = Truths(state=jnp.zeros((50, 6)), alive=jnp.zeros(50, dtype=bool))
    motion = jax.random.normal(jax.random.key(5), (80, 50, 3, 2))

    def begin(motion):
        return begin_truths(nobody, jnp.asarray(0), draws(50, motion, birth_count=0.9), crowd)[0]

    later = jax.tree.map(lambda leaf: leaf.reshape(4000, *leaf.shape[2:]), jax.vmap(begin)(motion))
    assert bool(jnp.all(later.alive))
    first, second = (np.asarray(spherical(position(truths.state))) for truths in (born, later))
    for quantity in range(3):
        levels = np.linspace(0.05, 0.95, 10)
        spread = first[:, quantity].max() - first[:, quantity].min()
        gap = np.quantile(first[:, quantity], levels) - np.quantile(second[:, quantity], levels)
        assert np.abs(gap).max() < 0.05 * spread
    np.testing.assert_allclose(velocity(later.state).std(), params.truth_velocity_sigma, rtol=0.03)


def flight(rows, steps, **numbers):
    """States `[steps + 1, N, 6]` of truths that fly without noise from the same state."""
    params = Params(truth_process_noise=0.0, **numbers)
    start = jnp.broadcast_to(jnp.array([1000.0, 30, -200, -40, 50, 5]), (rows, 6))
    states = [Truths(state=start, alive=jnp.ones(rows, dtype=bool))]
    for _ in range(steps):
        states.append(move(states[-1], jnp.ones((rows, 3, 2)), params))
    return np.stack([truths.state for truths in states])


def test_turning_truths_fly_circles_of_their_own_rate(x64):
    """A full circle of the outer rows in eight steps, in opposite senses; the middle row flies straight."""
    states = flight(3, 8, truth_turn_rate=np.pi / 4, time_step=1.0)
    velocities = states[..., 1::2]
    speed = np.linalg.norm(velocities, axis=-1)
    np.testing.assert_allclose(speed, speed[0, 0], rtol=1e-12)
    np.testing.assert_allclose(states[-1, ::2, :4], states[0, ::2, :4], atol=1e-9)
    np.testing.assert_allclose(states[2, 2, [1, 3]], [40, 30], rtol=1e-12)  # to the left
    np.testing.assert_allclose(states[2, 0, [1, 3]], [-40, -30], rtol=1e-12)
    np.testing.assert_allclose(states[8, :, 4], 90.0)
    np.testing.assert_array_equal(states[:, 1], flight(1, 8, time_step=1.0)[:, 0])


def test_accelerated_truths_fly_parabolas_in_all_directions(x64):
    rows, size, time = 50, 20.0, 4 * 0.5
    moved = flight(rows, 4, truth_acceleration=size, time_step=0.5)[-1] - flight(1, 4, time_step=0.5)[-1]
    np.testing.assert_allclose(np.linalg.norm(moved[:, 1::2], axis=-1), size * time, rtol=1e-12)
    np.testing.assert_allclose(moved[:, 0::2], moved[:, 1::2] * time / 2, atol=1e-9)
    directions = moved[:, 1::2] / (size * time)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(directions.T @ directions / rows, np.eye(3) / 3, atol=0.02)


def test_a_rate_or_an_acceleration_of_zero_is_straight_flight(x64):
    still = flight(3, 2, truth_turn_rate=0.0, truth_acceleration=0.0)
    np.testing.assert_allclose(still, flight(3, 2), rtol=1e-15)


def test_what_rests_in_the_world_comes_nearer_to_a_flying_platform(static):
    key, flying = jax.random.key(0), Params(platform_speed=200.0, truth_velocity_sigma=0.0)
    truths = initiate(key, static, flying)
    np.testing.assert_array_equal(velocity(truths.state), [[-200, 0, 0]] * 3)
    np.testing.assert_array_equal(position(truths.state), position(initiate(key, static, Params()).state))
