"""Tables of numbers that change during a training: how they are read, and what is refused."""

import pytest

from jaxtrack import Params, StaticParams
from train.ranges import check_ranges

STATIC, PARAMS = StaticParams(), Params()


def refusal(table, **more):
    """The message with which a table is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # callers compare the whole message
        check_ranges({"randomise": table, **more}, STATIC, PARAMS)
    return str(caught.value)


def test_ranges_within_the_limits_are_allowed_in_either_order():
    table = {"clutter_rate": (0, 8), "detection_probability": (1.0, 0.5), "initial_truths": (0, 10)}
    check_ranges({"curriculum": {"min_range": (1.0, 2e3)}, "randomise": table}, STATIC, PARAMS)


@pytest.mark.parametrize(
    ("name", "ends", "message"),
    [
        ("clutter_rate", (-1, 2), "clutter_rate = -1: expected a number in [0, 80] 1/look"),
        ("clutter_rate", (2, -1), "clutter_rate = -1: expected a number in [0, 80] 1/look"),
        ("clutter_rate", (0, 9), "clutter_rate = 9: expected at most max_clutter = 8 1/look"),
        (
            "detection_probability",
            (0, float("nan")),
            "detection_probability = nan: expected a number in [0, 1]",
        ),
        ("detection_probability", (True, 1), "detection_probability = True: expected a number in [0, 1]"),
        ("time_step", ("a", 1), "time_step = 'a': expected a number in (0, 1e+06] s"),
        ("initial_truths", (2, 11), "initial_truths = 11: expected an integer in [0, 10]"),
        ("initial_truths", (2.5, 5), "initial_truths = 2.5: expected an integer in [0, 10]"),
    ],
)
def test_both_ends_are_checked_as_the_scenario_is(name, ends, message):
    assert refusal({name: ends}) == f"randomise.{name}: {message}"


@pytest.mark.parametrize("ends", [3, (1,), (1, 2, 3), {}])
def test_a_range_has_two_ends(ends):
    assert (
        refusal({"time_step": ends}) == f"randomise.time_step = {ends!r}: expected two numbers, from and to"
    )


@pytest.mark.parametrize("name", ["nonsense", "field_limit", "max_steps_in_episode", "num_truths"])
def test_what_can_not_change_is_refused_and_what_can_is_listed(name):
    message = refusal({name: (1, 2)})
    assert message.startswith(f"randomise.{name}: can not change, expected one of alpha, ")
    assert " clutter_rate, " in message
    assert f" {name}," not in message


def test_numbers_that_change_must_go_together_at_each_of_their_ends():
    message = refusal({"min_range": (1000.0, 3000.0)}, curriculum={"max_range": (2000.0, 9000.0)})
    assert message.startswith("randomise and curriculum: min_range = ")


def test_a_number_changes_in_one_way_only():
    message = refusal({"clutter_rate": (0, 1)}, curriculum={"clutter_rate": (0, 2)})
    assert message == "curriculum.clutter_rate: expected in one table only, it stands in two"
