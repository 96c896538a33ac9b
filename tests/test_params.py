"""Shapes and choices: what is refused, and how the message names it; numbers are leaves."""

import dataclasses
import math
import re

import jax
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.params import CONVERTED_MEASURES, MEASURES, REWARDS, looks_per_axis


def test_looks_per_axis_of_the_paper():
    assert looks_per_axis(math.radians(120), math.radians(9)) == 19
    assert StaticParams().num_looks == 19


def test_looks_per_axis_is_not_rounded_up_by_the_last_bit():
    spacing = 0.3 * math.sqrt(2) / 2
    assert looks_per_axis(spacing * 7, 0.3) == 7
    assert looks_per_axis(spacing * 7.01, 0.3) == 8


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_truths", 0),
        ("max_tracks", -1),
        ("max_detections", 2.0),
        ("max_clutter", -1),
        ("map_size", 1),
        ("num_looks", 1),
        ("max_tracks", True),
        ("num_truths", "3"),
        ("reward", "unknown"),
        ("filter", "particle"),
        ("filter", None),
        ("covariance_form", "joseph"),
        ("associator", "probabilistic"),
        ("deleters", "covariance"),
        ("deleters", ["covariance"]),
        ("deleters", ()),
        ("intersect_deleters", 1),
        ("initiator", "two_point"),
        ("min_points", 0),
    ],
)
def test_shapes_that_make_no_sense_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^{name} = {re.escape(repr(value))}: expected"):
        StaticParams(**{name: value})


def test_the_message_names_the_choices():
    with pytest.raises(ValueError, match=r"^deleters = 'age': expected one of covariance, update_time, "):
        StaticParams(deleters=("covariance", "age"))
    with pytest.raises(ValueError, match=r"^filter = 'x': expected one of unscented, extended, cubature, "):
        StaticParams(filter="x")


@pytest.mark.parametrize("measure", [name for name in MEASURES if name not in CONVERTED_MEASURES])
def test_converted_detections_have_no_noise_of_one_size(measure):
    message = rf"^measure = '{measure}': expected one of mahalanobis, .* with filter = 'converted'$"
    with pytest.raises(ValueError, match=message):
        StaticParams(filter="converted", measure=measure)


def test_the_smallest_shapes_are_allowed():
    StaticParams(num_truths=1, max_tracks=1, max_detections=1, max_clutter=0, map_size=2, num_looks=2)


def test_shapes_are_hashable_and_compare_by_value():
    assert hash(StaticParams(max_tracks=7)) == hash(StaticParams(max_tracks=7))
    assert StaticParams(max_tracks=7) != StaticParams(max_tracks=8)


@pytest.mark.parametrize("reward", REWARDS)
def test_every_reward_is_a_choice(reward):
    assert StaticParams(reward=reward).reward == reward


def test_the_numbers_are_traced_leaves():
    quantities = [field for field in dataclasses.fields(Params) if "low" in field.metadata]
    always = [field for field in quantities if field.default is not None]
    assert len(jax.tree.leaves(Params())) == len(always)
    doubled = jax.tree.map(lambda number: 2 * number, Params())
    assert doubled.time_step == 2 * Params().time_step
