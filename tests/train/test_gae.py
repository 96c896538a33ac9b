"""Advantages against arithmetic done by hand, discount 1/2 and decay 1/2 throughout."""

import jax.numpy as jnp
import numpy as np
import pytest

from train.gae import advantages

REWARD, VALUE = [1.0, 2.0, 4.0], [1.0, 1.0, 1.0]


def column(next_value, terminated=(0, 0, 0), done=(0, 0, 0), gamma=0.5, gae_lambda=0.5):
    """Advantages of three steps of one environment."""
    rows = [jnp.array(row, dtype=float)[:, None] for row in (REWARD, VALUE, next_value, terminated, done)]
    return np.asarray(advantages(*rows, gamma, gae_lambda))[:, 0]


def test_an_episode_that_goes_on_is_bootstrapped_from_the_value_after_the_last_step():
    # Deltas: 1 + 1/2 - 1 = 0.5; 2 + 1/2 - 1 = 1.5; 4 + 6/2 - 1 = 6.
    # Sums:   6;  1.5 + 6/4 = 3;  0.5 + 3/4 = 1.25.
    np.testing.assert_allclose(column([1, 1, 6]), [1.25, 3.0, 6.0])


def test_after_a_termination_nothing_follows():
    # The middle step's delta is 2 - 1 = 1, whatever the next value (8); the sum begins anew:
    # 6;  1;  0.5 + 1/4 = 0.75.
    np.testing.assert_allclose(column([1, 8, 6], terminated=[0, 1, 0], done=[0, 1, 0]), [0.75, 1.0, 6.0])


def test_a_truncation_is_bootstrapped_from_the_final_value():
    # The middle step's delta is 2 + 8/2 - 1 = 5; the last step belongs to the next episode:
    # 6;  5;  0.5 + 5/4 = 1.75.
    np.testing.assert_allclose(column([1, 8, 6], done=[0, 1, 0]), [1.75, 5.0, 6.0])


def test_a_termination_on_the_last_step():
    # Deltas 0.5, 1.5 and 4 - 1 = 3; sums 3; 1.5 + 3/4 = 2.25; 0.5 + 2.25/4 = 1.0625.
    np.testing.assert_allclose(column([1, 1, 6], terminated=[0, 0, 1], done=[0, 0, 1]), [1.0625, 2.25, 3.0])


@pytest.mark.parametrize("following", [0.0, 1e6])
def test_nothing_leaks_over_the_end_of_an_episode(following):
    reward = jnp.array([[1.0], [2.0], [following]])
    done = jnp.array([[False], [True], [False]])
    value = jnp.ones((3, 1))
    result = advantages(reward, value, value, jnp.zeros((3, 1), dtype=bool), done, 0.5, 0.5)
    # 2 + 1/2 - 1 = 1.5;  0.5 + 1.5/4 = 0.875.
    np.testing.assert_allclose(result[:2, 0], [0.875, 1.5])


def test_decay_one_gives_discounted_returns_and_decay_zero_single_steps():
    # Return minus value: 1 + 2/2 + 4/4 + 6/8 - 1 = 2.75;  2 + 4/2 + 6/4 - 1 = 4.5;  4 + 6/2 - 1 = 6.
    np.testing.assert_allclose(column([1, 1, 6], gae_lambda=1.0), [2.75, 4.5, 6.0])
    np.testing.assert_allclose(column([1, 1, 6], gae_lambda=0.0), [0.5, 1.5, 6.0])


def test_environments_do_not_mix():
    reward = jnp.array([[1.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    value, next_value = jnp.ones((3, 2)), jnp.array([[1.0, 2.0], [1.0, 2.0], [6.0, 2.0]])
    off = jnp.zeros((3, 2), dtype=bool)
    result = np.asarray(advantages(reward, value, next_value, off, off, 0.5, 0.5))
    np.testing.assert_allclose(result, [[1.25, 0.0], [3.0, 0.0], [6.0, 0.0]])
