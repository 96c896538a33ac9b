"""Options that are tables: words of the command line to numbers by name, and back."""

from typing import get_args

import pytest

from jaxtrack.cli import parse
from train.config import TrainConfig
from train.early_stop import Thresholds
from train.ranges import Ranges

OF_RANGES, OF_THRESHOLDS = get_args(Ranges)[1], get_args(Thresholds)[1]


def test_words_become_ranges_and_whole_numbers_stay_whole():
    words = ["clutter-rate=0:0.2", "initial_truths=2:10", "kappa=-3:-1e-3"]
    ranges = OF_RANGES.instance_from_str(words)
    assert ranges == {"clutter_rate": (0, 0.2), "initial_truths": (2, 10), "kappa": (-3, -0.001)}
    assert all(isinstance(end, int) for end in ranges["initial_truths"])
    assert OF_RANGES.instance_from_str([]) == {}
    for table, option in ((ranges, OF_RANGES), ({"completeness": 0.9, "entropy": -1}, OF_THRESHOLDS)):
        assert option.is_instance(table)
        assert option.instance_from_str(option.str_from_instance(table)) == table


@pytest.mark.parametrize("word", ["clutter_rate", "clutter_rate=", "clutter_rate=1", "a=0:1:2", "a=b:c"])
def test_a_word_that_is_no_range_is_named(word):
    with pytest.raises(ValueError, match=f"'{word}': expected NAME=FROM:TO, such as clutter_rate=0:0.2"):
        OF_RANGES.instance_from_str([word])


@pytest.mark.parametrize("word", ["completeness", "completeness=", "completeness=0:1", "completeness=high"])
def test_a_word_that_is_no_threshold_is_named(word):
    with pytest.raises(ValueError, match=f"'{word}': expected COLUMN=NUMBER, such as completeness=0.9"):
        OF_THRESHOLDS.instance_from_str([word])


@pytest.mark.parametrize("before", [{}, {"time_step": (0.01, 0.1)}])
def test_the_command_line_wins_as_a_whole_table(before):
    config = TrainConfig(randomise=before)
    assert parse(config, [], "prog").randomise == before
    words = ["--randomise", "clutter_rate=0:1", "birth_rate=0:0.1", "--stop-above", "completeness=0.9"]
    parsed = parse(config, words, "prog")
    assert parsed.randomise == {"clutter_rate": (0, 1), "birth_rate": (0, 0.1)}
    assert parsed.stop_above == {"completeness": 0.9}
    assert parse(config, ["--randomise"], "prog").randomise == {}
