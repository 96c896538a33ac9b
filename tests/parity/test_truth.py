"""Manoeuvres of `truth` against Stone Soup's KnownTurnRate and ConstantAcceleration."""

import datetime

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stonesoup.models.transition.linear import ConstantAcceleration, KnownTurnRate

from jaxtrack import Params, Truths
from jaxtrack.truth import move_truths, process_noise_factor, spread_directions

ROWS, DT, Q = 5, 0.7, 3.0
STEP = datetime.timedelta(seconds=DT)


@pytest.fixture
def states(x64):
    return np.random.default_rng(0).normal(size=(ROWS, 6)) * np.tile([1000, 30], 3)


def moved(states, **numbers):
    """States after one step without noise."""
    truths = Truths(state=jnp.asarray(states), alive=jnp.ones(ROWS, dtype=bool))
    params = Params(time_step=DT, truth_process_noise=Q, **numbers)
    return np.asarray(jax.jit(move_truths)(truths, jnp.zeros((ROWS, 3, 2)), params).state)


def test_coordinated_turns(states):
    ours = moved(states, truth_turn_rate=0.9)
    for row, rate in enumerate(np.linspace(-0.9, 0.9, ROWS)):
        if rate == 0:  # Stone Soup's divides by it
            continue
        model = KnownTurnRate(turn_noise_diff_coeffs=[Q, Q], turn_rate=rate)
        np.testing.assert_allclose(
            ours[row, :4], model.matrix(time_interval=STEP) @ states[row, :4], rtol=1e-12
        )
        factor = process_noise_factor(DT, Q)
        noise = model.covar(time_interval=STEP)
        np.testing.assert_allclose(noise, np.kron(np.eye(2), factor @ factor.T), rtol=1e-12)


def test_constant_acceleration(states):
    ours = moved(states, truth_acceleration=8.0)
    F = ConstantAcceleration(noise_diff_coeff=0.0).matrix(time_interval=STEP)
    accelerations = 8.0 * np.asarray(spread_directions(ROWS))
    theirs = np.stack([states[:, 0::2], states[:, 1::2], accelerations], axis=-1) @ F.T
    np.testing.assert_allclose(ours, theirs[..., :2].reshape(ROWS, 6), rtol=1e-12)
