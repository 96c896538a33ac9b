"""The page of results: the paper's numbers, ours, and what is said of their order."""

import dataclasses

import pytest

from jaxtrack import Params, StaticParams
from tests.train.compared import THREE, comparison, played
from train import results_page
from train.episode_metrics import METRICS
from train.paper import PAPER, open_places
from train.results import summarise

RISING, FALLING = [1.0, 1.2, 1.1, 0.9], [0.2, 0.3, 0.1, 0.2]


def page(compared, tmp_path):
    pictures = {"gospa": tmp_path / "pictures" / "gospa.png"}
    return results_page.render(
        compared, summarise(compared.played), StaticParams(), Params(), 5, "the command", pictures, tmp_path
    )


def order(compared, reading="track_to_target_ratio", column="t2t"):
    return results_page.order_of(compared.played, summarise(compared.played).mean, reading, column)


def test_the_page_holds_both_tables_the_figures_and_how_it_was_made(tmp_path):
    text = page(THREE, tmp_path)
    for words in (
        "arXiv:2503.01293",
        "| Random | random | 1.585 |",
        "| 730.56.27 ± 744.81 (sic) |",
        "| PPO-BiGRU-MHSA | – | 1.152 |",  # noqa: RUF001
        "![gospa](pictures/gospa.png)",
        "the command",
        "seed of the scenarios 5; training seeds: own 0, 7",
        "4 scenarios of 1000 steps of 5 ms",
        "no order to compare, coverage not played",
        *(f"| {label} |" for label in METRICS.values()),
    ):
        assert words in text
    # Every line of a table has as many cells as its head.
    for block in text.split("\n\n"):
        if block.startswith("|"):
            assert len({line.count("|") for line in block.splitlines()}) == 1


def test_the_papers_numbers_are_those_of_its_table():
    assert {row.ours: (row.t2t, row.norm) for row in PAPER} == {
        "coverage": (0.942, 574.27),
        "random": (1.585, 948.15),
        "static": (0.288, 2630.72),
        "flatten": (1.407, 790.63),
        "bigru": (1.430, 730.56),
        "mhsa": (1.152, 461.98),
    }


def test_the_order_is_read_from_the_data():
    high, middle, low = played([5.0, 5.5, 5.2, 5.1]), played(RISING), played(FALLING)
    said = order(comparison(random=high, coverage=middle, static=low))
    assert "random 5.200 > coverage 1.050 > static 0.200 (each above the next with 95 % confidence)" in said
    assert said.endswith("the paper's order.")
    said = order(comparison(random=middle, coverage=high, static=low))
    assert said.endswith("not the paper's, random > coverage > static.")
    # The paper's norms have another order than its ratios.
    said = order(comparison(random=middle, coverage=low, static=high), "covariance_norm_mean", "norm")
    assert said.endswith("; the paper's order.")


def test_an_order_by_chance_is_called_so():
    by_chance = played([0.9, 1.1, 1.3, 0.8])
    said = order(comparison(random=played([5.0, 5.5, 5.2, 5.1]), coverage=played(RISING), static=by_chance))
    assert "not every step of it beyond chance" in said


def test_our_choices_are_the_numbers_that_were_played():
    params = Params(gospa_cutoff=123.0, elevation_sigma=7e-3, clutter_rate=0.25)
    said = str(open_places(StaticParams(num_truths=17), params))
    for words in ("c = 123 m", "elevation and bearing 7 and 2 mrad", "0.25 false", "'17'"):
        assert words in said
    changed = dataclasses.replace(params, deletion_threshold=4321.0)
    assert "above 4321" in str(open_places(StaticParams(), changed))


@pytest.mark.parametrize("name", ["random", "coverage", "static"])
def test_the_papers_baselines_are_policies_of_ours(name):
    from jaxtrack.policies import POLICIES

    assert name in POLICIES
