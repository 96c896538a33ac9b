"""What the command accepts and refuses, before anything is tracked."""

import pytest

from jaxtrack import Params, StaticParams, track
from jaxtrack.cli import run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A file of one detection."""
    path = tmp_path_factory.mktemp("recorded") / "detections.csv"
    path.write_text("time,elevation,bearing,range\n0,0.1,0.2,3000\n")
    return path


def test_numbers_come_from_the_file_and_the_command_line_wins(recorded, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(track, "track_file", lambda recorded, params, options, static: seen.append(params))
    for name, text in (("a.toml", "alpha = 1\nbeta = 3.5\n"), ("a.json", '{"alpha": 1, "beta": 3.5}')):
        (tmp_path / name).write_text(text)
        argv = [str(recorded), "--out", str(tmp_path / "out.csv"), "--config", str(tmp_path / name)]
        track.main([*argv, "--set", "alpha=0.7", "--set", "kappa = -2"])
    assert seen == [Params(alpha=0.7, beta=3.5, kappa=-2.0)] * 2
    numbers = [getattr(seen[0], name) for name in track.TRACKER_FIELDS]
    assert all(type(number) is float for number in numbers if number is not None)


def test_parts_come_from_the_file_and_the_command_line_wins(recorded, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(track, "track_file", lambda *_: seen.append(_[1:]))
    text = (
        'filter = "extended"\ndeleters = ["covariance", "update_time"]\nmin_points = 4\ndeletion_time = 2\n'
    )
    (tmp_path / "a.toml").write_text(text)
    argv = [str(recorded), "--out", str(tmp_path / "out.csv"), "--config", str(tmp_path / "a.toml")]
    track.main([*argv, "--set", "filter=cubature", "--set", "initiator=multi_measurement"])
    track.main(
        [*argv, "--set", "deleters=update_time_steps", "--set", "deletion_steps=3", "--set", "min_points=2"]
    )
    track.main([*argv, "--set", "intersect_deleters=True"])
    first, second, third = (static for _, _, static in seen)
    parts = {"min_points": 4, "deleters": ("covariance", "update_time")}
    assert first == StaticParams(filter="cubature", initiator="multi_measurement", **parts)
    assert second == StaticParams(filter="extended", deleters=("update_time_steps",))
    assert third == StaticParams(filter="extended", intersect_deleters=True, **parts)
    assert seen[1][0].deletion_steps == 3


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"filter": "particle"}, "filter = 'particle': expected one of unscented, extended"),
        ({"deleters": "covariance,age"}, "deleters = 'age': expected one of covariance"),
        ({"deleters": 3}, "deleters = 3: expected a tuple of names"),
        ({"min_points": "two"}, "min_points = 'two': expected an integer in [1, 10000]"),
        ({"intersect_deleters": "maybe"}, "intersect_deleters = 'maybe': expected True or False"),
    ],
)
def test_wrong_parts_are_refused(values, words):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the message is compared
        track.build_static(values)
    assert words in str(caught.value)


def test_a_deleter_without_its_number_is_refused(recorded, tmp_path):
    with pytest.raises(ValueError, match="deletion_time = None: expected a number"):
        track.main([str(recorded), "--out", str(tmp_path / "o.csv"), "--set", "deleters=update_time"])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"time_step": 0.1},
            "time_step: no number of the tracker; expected one of elevation_sigma, bearing_sigma",
        ),
        ({"sigma": 1}, "sigma: no number of the tracker"),
        ({"alpha": "wide"}, "alpha = 'wide': expected a number in (0, 1e+09]"),
        ({"alpha": -1.0}, "alpha = -1.0: expected a number in (0, 1e+09]"),
        ({"range_sigma": 0.0}, "range_sigma = 0.0: expected a number in (0, 1e+09] m"),
        ({"kappa": "nan"}, "kappa = nan: expected a number in [-5, 1e+09]"),
        ({"alpha": True}, "alpha = True: expected a number"),
        ({"alpha": [1.0, 2.0]}, "alpha = [1.0, 2.0]: expected a number"),
        ({"params": {"alpha": 1.0}}, "params: no number of the tracker"),
    ],
)
def test_wrong_numbers_are_refused(values, words):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the message is compared
        track.build_params(values)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["{in}"], "--out"),
        (["--out", "{tmp}/o.csv"], "PATH"),
        (
            ["{in}", "--out", "{tmp}/no/o.csv"],
            "out = '{tmp}/no/o.csv': expected a file in a folder that exists",
        ),
        (["{in}", "--out", "{tmp}"], "out = '{tmp}': expected a file"),
        (["{in}", "--out", "{in}"], "out = '{in}': is the file of detections, which would be lost"),
        (["{tmp}/o.csv.partial", "--out", "{tmp}/o.csv"], "is the file of detections, which would be lost"),
        (
            ["{in}", "--out", "{tmp}/o.png", "--plot", "{tmp}/o.png"],
            "plot = '{tmp}/o.png': is the file of out",
        ),
        (
            ["{in}", "--out", "{tmp}/o.csv", "--plot", "{tmp}/o.gif"],
            "expected a name that ends in .png, .pdf, .svg",
        ),
        (["{in}", "--out", "{tmp}/o.csv", "--plot", "{tmp}/no/o.png"], "plot = '{tmp}/no/o.png'"),
        (["{tmp}/nothing.csv", "--out", "{tmp}/o.csv"], "No such file or directory: '{tmp}/nothing.csv'"),
        (["{in}", "--out", "{tmp}/o.csv", "--set", "alpha"], "set = 'alpha': expected name=value"),
        (["{in}", "--out", "{tmp}/o.csv", "--config"], "config: expected the name"),
    ],
)
def test_wrong_options_end_in_one_line_and_code_2(argv, words, recorded, tmp_path, monkeypatch, capsys):
    def filled(text):
        return text.replace("{in}", str(recorded)).replace("{tmp}", str(tmp_path))

    before = recorded.read_bytes()
    monkeypatch.setattr("sys.argv", ["track", *map(filled, argv)])
    with pytest.raises(SystemExit) as stop:
        run(track.main)
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert filled(words) in said
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert recorded.read_bytes() == before
    assert not list(tmp_path.iterdir())


def test_help_lists_options_and_numbers(capsys):
    with pytest.raises(SystemExit) as stop:
        track.main(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    for words in ("--out PATH", "--config FILE", "--set", "--plot", "range_sigma = 5 m, in (0, 1e+09]"):
        assert words in said
    for name in (*track.TRACKER_FIELDS, *track.TRACKER_CHOICES):
        assert f"{name} = " in said
    assert "filter = unscented, of unscented, extended, cubature, converted" in said
