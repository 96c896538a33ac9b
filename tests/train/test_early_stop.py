"""The thresholds that end a training: which there are, and when one is passed."""

import pytest

from train.early_stop import check_thresholds, passed

ROW = {"update": "7", "completeness": "0.5", "reward": "-3", "episode_return": ""}


def test_a_threshold_is_passed_on_its_own_side_and_not_when_met():
    assert passed(ROW, {"completeness": 0.4}, {}) == "completeness = 0.5 is above 0.4"
    assert passed(ROW, {}, {"reward": -2.5}) == "reward = -3 is below -2.5"
    for threshold in (0.5, 0.6):
        assert passed(ROW, {"completeness": threshold}, {}) == ""
    for threshold in (-3.0, -4.0):
        assert passed(ROW, {}, {"reward": threshold}) == ""
    assert passed(ROW, {}, {}) == ""


def test_one_threshold_of_several_is_enough():
    assert passed(ROW, {"reward": 0, "completeness": 0.4}, {"reward": -9}) != ""
    assert passed(ROW, {"reward": 0}, {"reward": -9, "completeness": 0.6}) != ""
    assert passed(ROW, {"reward": 0, "completeness": 0.6}, {"reward": -9}) == ""


def test_an_empty_cell_passes_nothing():
    assert passed(ROW, {"episode_return": -1e9}, {"episode_return": 1e9}) == ""


@pytest.mark.parametrize(
    ("name", "threshold", "message"),
    [
        ("gospa", 100, "stop_below.gospa: expected one of reward, "),
        ("seconds", 100, "stop_below.seconds: expected one of reward, "),
        ("reward", "much", "stop_below.reward = 'much': expected a number"),
        ("reward", True, "stop_below.reward = True: expected a number"),
        ("reward", float("nan"), "stop_below.reward = nan: expected a number"),
        ("reward", float("inf"), "stop_below.reward = inf: expected a number"),
    ],
)
def test_what_there_is_not_is_refused(name, threshold, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the message is compared below
        check_thresholds("stop_below", {"completeness": 1, name: threshold}, ("gospa_missed",))
    assert str(caught.value).startswith(message)
    check_thresholds("stop_below", {"gospa_missed": 100.0}, ("gospa_missed",))
