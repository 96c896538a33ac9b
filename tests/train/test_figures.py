"""Figures of a comparison: what they show, and that they read in grey."""

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from jaxtrack import Params
from tests.train.compared import STEPS, THREE, comparison, played
from train import figures
from train.episode_metrics import CURVES
from train.results import summarise

PARAMS = Params(time_step=0.5)


@pytest.fixture
def saved(monkeypatch):
    """The figures that were written, kept for a look at what they show."""
    kept = []
    write = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a: (kept.append(self), write(self, *a))[1])
    return kept


def test_all_figures_are_written(tmp_path):
    paths = figures.draw_all(THREE.played, summarise(THREE.played), PARAMS, tmp_path)
    assert list(paths) == list(figures.FIGURES)
    for path in paths.values():
        with Image.open(path) as image:
            assert image.format == "PNG"
            assert np.asarray(image.convert("L")).std() > 5


def test_curves_have_a_band_a_unit_and_a_name_at_their_end(tmp_path, saved):
    figures.over_time(THREE.played, figures.GOSPA, PARAMS, tmp_path / "gospa.png")
    (figure,) = saved
    assert [axes.get_title() for axes in figure.axes] == [CURVES[name] for name in figures.GOSPA]
    axes = figure.axes[0]
    assert axes.get_xlabel() == "time (s)"
    for line, band, policy in zip(axes.get_lines(), axes.collections, THREE.played, strict=True):
        mean = THREE.played[policy].curves["gospa"].mean
        np.testing.assert_allclose(
            line.get_xydata(), np.stack([0.5 * np.arange(1, STEPS + 1), mean], axis=-1)
        )
        heights = band.get_paths()[0].vertices[:, 1]
        assert heights.min() == mean.min() - 1
        assert heights.max() == mean.max() + 1
    assert [label.get_text() for label in figure.legends[0].get_texts()] == list(THREE.played)
    # From bottom to top as the curves end, and none on top of another.
    labels = {text.get_text(): text.xy[1] for text in axes.texts}
    assert sorted(labels, key=labels.get) == ["static", "own", "random"]
    assert np.diff(sorted(labels.values())).min() > figures.LABEL_GAP - 1e-9


def test_a_name_far_from_its_curve_is_left_to_the_legend(saved):
    _, axes = plt.subplots()
    axes.set_ylim(0, 1)
    ends = {f"low {number}": 0.0 for number in range(9)} | {"high": 0.9}
    figures.label_ends(axes, ends)
    labels = {text.get_text(): text.xy[1] for text in axes.texts}
    assert list(labels) == ["low 0", "low 1", "low 2", "high"]
    np.testing.assert_allclose(list(labels.values()), [0, 0.07, 0.14, 0.9])


def test_eight_policies_differ_without_colour():
    styles = [figures.line_style(number, trained=False) for number in range(8)]
    assert len({str(style["ls"]) for style in styles}) == 8
    assert figures.line_style(0, trained=True)["color"] != styles[0]["color"]


def test_curves_that_are_nowhere_known_or_zero_are_drawn(tmp_path, saved):
    nothing = played([0.0, 0.0])
    for curve in nothing.curves.values():
        curve.mean[:], curve.low[:], curve.high[:] = np.nan, np.nan, np.nan
    nothing.curves["gospa"].mean[:] = 0.0
    figures.over_time({"none": nothing}, ("gospa", "covariance_x"), PARAMS, tmp_path / "zero.png")
    zero, unknown = saved[0].axes
    assert [text.get_text() for text in zero.texts] == ["none"]
    assert not list(unknown.texts)


def test_the_matrix_shows_rows_against_columns(tmp_path, saved):
    figures.improvement(summarise(THREE.played), "gospa", tmp_path / "matrix.png")
    (axes,) = saved[0].axes
    image = axes.get_images()[0].get_array()
    assert image[0, 1] == 0.75  # own against random
    assert image[1, 0] == 0.25
    assert np.isnan(np.ma.filled(image, np.nan)[1, 1])
    assert "less is better" in axes.get_title()
    # White on dark, black on light.
    for text in axes.texts:
        column, row = map(int, text.get_position())
        assert (text.get_color() == "white") == (image[row, column] > 0.6)


def test_looks_are_drawn_with_azimuth_to_the_right_and_elevation_up(tmp_path, saved):
    figures.looks(comparison(own=played([1.0]), other=played([2.0])).played, PARAMS, tmp_path / "looks.png")
    axes = saved[0].axes[0]
    image = axes.get_images()[0]
    assert image.origin == "lower"
    assert image.get_array()[0, 2] == 0.75  # lowest row, rightmost column
    assert image.get_extent() == pytest.approx([-90, 90, -90, 90])  # three looks of 60 degrees
    assert axes.get_title() == "own\nup to 75 % of dwells"
    assert "°" in axes.get_xlabel()
