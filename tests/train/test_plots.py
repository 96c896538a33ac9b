import os
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from train import plots

TABLE = {
    "random": {
        "gospa": (269.0, 260.0, 278.0),
        "completeness": (0.63, 0.61, 0.65),
        "uncertainty_per_truth": (2500.0, 2400.0, 2600.0),
    },
    "index rule": {
        "gospa": (120.0, 114.0, 126.0),
        "completeness": (0.87, 0.86, 0.88),
        "uncertainty_per_truth": (1000.0, 950.0, 1050.0),
    },
}

TITLES = {"gospa": "GOSPA", "completeness": "share", "uncertainty_per_truth": "uncertainty"}


@pytest.fixture
def saved(monkeypatch):
    """The figures that were written, kept for a look at what they show."""
    figures = []
    write = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a: (figures.append(self), write(self, *a))[1])
    return figures


def write_metrics(path, header, rows):
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def check_picture(path):
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert 700 <= image.width <= 900
        assert np.asarray(image.convert("L")).std() > 5


def test_a_learning_curve_shows_every_metric_against_steps(tmp_path, saved):
    rows = [f"{n * 1_000_000},{n},{n * 2.0},0.{n},{1000 - n},7" for n in range(1, 6)]
    header = "env_steps,seconds,episode_return,completeness,covariance_norm_mean,loss"
    source = write_metrics(tmp_path / "metrics.csv", header, rows)
    plots.learning_curve(source, tmp_path / "curve.png")
    check_picture(tmp_path / "curve.png")
    lines = [axes.get_lines()[0] for axes in saved[0].axes]
    for line, values in zip(
        lines, ([2, 4, 6, 8, 10], [0.1, 0.2, 0.3, 0.4, 0.5], range(999, 994, -1)), strict=True
    ):
        np.testing.assert_allclose(line.get_xdata(), [1, 2, 3, 4, 5])
        np.testing.assert_allclose(line.get_ydata(), values)


def test_empty_cells_and_missing_columns_are_left_out(tmp_path, saved):
    rows = ["1000000,,0.5", "2000000,3.0,0.6", "3000000,broken,0.7", "4000000,5.0,"]
    source = write_metrics(tmp_path / "metrics.csv", "env_steps,episode_return,completeness", rows)
    plots.learning_curve(source, tmp_path / "curve.png")
    returns, completeness = (axes.get_lines()[0] for axes in saved[0].axes)
    np.testing.assert_allclose(returns.get_xydata(), [[2, 3], [4, 5]])
    np.testing.assert_allclose(completeness.get_xydata(), [[1, 0.5], [2, 0.6], [3, 0.7]])


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("env_steps,completeness", [], "no row"),
        ("steps,completeness", ["1,0.5"], "expected env_steps"),
        ("env_steps,loss", ["1,0.5"], "episode_return"),
    ],
)
def test_a_file_without_curves_is_refused(tmp_path, header, rows, message):
    source = write_metrics(tmp_path / "metrics.csv", header, rows)
    with pytest.raises(ValueError, match=message):
        plots.learning_curve(source, tmp_path / "curve.png")
    assert not (tmp_path / "curve.png").exists()


def test_a_comparison_puts_mean_and_interval_of_each_policy_in_its_row(tmp_path, saved):
    plots.comparison(TABLE, TITLES, tmp_path / "comparison.png")
    check_picture(tmp_path / "comparison.png")
    panels = saved[0].axes
    assert [label.get_text() for label in panels[0].get_yticklabels()] == list(TABLE)
    for axes, metric in zip(panels, TITLES, strict=True):
        mean, low, high = np.array([metrics[metric] for metrics in TABLE.values()]).T
        np.testing.assert_allclose(axes.get_lines()[0].get_xydata(), np.stack([mean, [0, 1]], axis=-1))
        ends = np.array(axes.collections[0].get_segments())
        np.testing.assert_allclose(ends[:, :, 0], np.stack([low, high], axis=-1))
        np.testing.assert_allclose(ends[:, :, 1], [[0, 0], [1, 1]])
    assert [axes.get_title() for axes in panels] == list(TITLES.values())
    assert panels[0].yaxis_inverted()


def test_a_comparison_with_holes_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nothing to draw"):
        plots.comparison({}, TITLES, tmp_path / "comparison.png")
    holed = {**TABLE, "static": {"gospa": (446.0, 440.0, 452.0)}}
    with pytest.raises(ValueError, match=r"static.* lacks completeness, uncertainty_per_truth"):
        plots.comparison(holed, TITLES, tmp_path / "comparison.png")
    assert list(tmp_path.iterdir()) == []


def test_plots_leave_no_open_figures_and_import_matplotlib_lazily(tmp_path):
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    plots.comparison(TABLE, TITLES, tmp_path / "comparison.png")
    assert pyplot.get_fignums() == before
    code = "import sys, train.plots; print('matplotlib' in sys.modules)"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "False"
