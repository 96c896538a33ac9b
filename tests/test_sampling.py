"""Poisson numbers from uniform draws; their law is tested in `test_clutter`."""

import jax.numpy as jnp
import pytest

from jaxtrack.sampling import poisson_quantile


@pytest.mark.parametrize("largest", [0, 1, 5])
def test_no_number_exceeds_the_largest_and_that_one_can_come(largest):
    assert int(poisson_quantile(jnp.asarray(0.999), 30.0, largest)) == largest
