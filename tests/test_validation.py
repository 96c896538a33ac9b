"""Numbers: what is refused, and how the message names it."""

import dataclasses
import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.validation import check_trajectories, validate

QUANTITIES = [field for field in dataclasses.fields(Params) if "low" in field.metadata]


@pytest.mark.parametrize(
    ("deleter", "name", "good"),
    [("update_time", "deletion_time", 0.5), ("update_time_steps", "deletion_steps", 3)],
)
def test_a_deleter_by_time_needs_its_number(deleter, name, good):
    static = StaticParams(deleters=("covariance", deleter))
    with pytest.raises(ValueError, match=rf"^{name} = None: expected a number for deleters = "):
        validate(static, Params())
    validate(static, Params(**{name: good}))
    validate(StaticParams(), Params(**{name: good}))
    for bad in (0, -1, True, "many", [good]):
        with pytest.raises(ValueError, match=rf"^{name} = "):
            validate(static, Params(**{name: bad}))


def test_the_default_numbers_are_valid():
    validate(StaticParams(), Params())


@pytest.mark.parametrize("field", QUANTITIES, ids=lambda field: field.name)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, "many"])
def test_what_is_no_finite_number_is_refused_by_name(field, bad):
    with pytest.raises(ValueError, match=rf"^{field.name} = .*expected a (whole )?number in"):
        validate(StaticParams(), Params(**{field.name: bad}))


@pytest.mark.parametrize("field", QUANTITIES, ids=lambda field: field.name)
def test_the_lower_end_of_each_range_is_open_or_closed_as_stated(field):
    low = field.metadata["low"]
    below = np.nextafter(low, -math.inf)
    refused, expected = (low, "\\(") if field.metadata["open_low"] else (below, "\\[")
    with pytest.raises(ValueError, match=rf"^{field.name} = .*{expected}{low:g}, "):
        validate(StaticParams(), Params(**{field.name: refused}))
    if not field.metadata["open_low"]:
        # The smallest range of births may not exceed the largest.
        validate(StaticParams(), Params(**{"min_range": 1.0, field.name: low}))


@pytest.mark.parametrize("field", QUANTITIES, ids=lambda field: field.name)
def test_the_upper_end_of_each_range_is_closed(field):
    high = field.metadata["high"]
    static = StaticParams(max_clutter=80)
    validate(static, Params(**{"max_range": 1e9, field.name: high}))
    with pytest.raises(ValueError, match=rf"^{field.name} = .*, {re.escape(f'{high:g}')}\]"):
        validate(static, Params(**{field.name: 2 * high}))


def test_the_message_names_value_range_and_unit():
    with pytest.raises(ValueError, match=r"^time_step = -0\.1: expected a number in \(0, 1e\+06\] s$"):
        validate(StaticParams(), Params(time_step=-0.1))
    with pytest.raises(ValueError, match=r"^alpha = -0\.1: expected a number in \(0, 1e\+09\]$"):
        validate(StaticParams(), Params(alpha=-0.1))


def test_arrays_meant_for_vmap_are_checked_entry_by_entry():
    validate(StaticParams(), Params(time_step=jnp.array([0.005, 0.05])))
    with pytest.raises(ValueError, match=r"^time_step = "):
        validate(StaticParams(), Params(time_step=jnp.array([0.005, -0.05])))
    with pytest.raises(ValueError, match=r"^detection_probability = "):
        validate(StaticParams(), Params(detection_probability=jnp.array([0.5, 1.5])))


def test_ranges_that_depend_on_each_other():
    with pytest.raises(ValueError, match=r"^min_range = 2000.0: expected at most max_range = 1000.0"):
        validate(StaticParams(), Params(min_range=2000.0, max_range=1000.0))
    with pytest.raises(ValueError, match=r"^min_range"):
        validate(StaticParams(), Params(min_range=np.array([1.0, 20_000.0])))
    validate(StaticParams(), Params(min_range=1000.0, max_range=1000.0))
    with pytest.raises(ValueError, match=r"^clutter_rate = 3.0: expected at most max_clutter = 2"):
        validate(StaticParams(max_clutter=2), Params(clutter_rate=3.0))
    validate(StaticParams(max_clutter=2), Params(clutter_rate=2.0))


@pytest.mark.parametrize("shape", [(4, 3, 5), (4, 2, 6), (3, 6), (0, 3, 6), (6,)])
def test_trajectories_of_a_wrong_shape_are_refused(shape):
    params = Params(trajectories=jnp.zeros(shape))
    for check in (validate, check_trajectories):
        with pytest.raises(ValueError, match=r"^trajectories has shape .*num_truths = 3, 6\]"):
            check(StaticParams(num_truths=3), params)


def test_trajectories_may_carry_a_batch_axis():
    validate(StaticParams(num_truths=3), Params(trajectories=jnp.zeros((8, 4, 3, 6))))
