"""Files of detections: read exactly, or refused with the line that is wrong."""

import datetime
import math

import numpy as np
import pytest

from jaxtrack.detection_file import RecordedDetections, microseconds, read_detections


def read(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "detections.csv"
    path.write_bytes(text.encode(encoding))
    return read_detections(path)


def test_columns_in_any_order_scans_of_equal_time_and_empty_scans(tmp_path):
    recorded = read(
        tmp_path,
        "range,time, bearing ,snr,elevation\n"
        "1000,0.5,0.1,9,-0.2\n"
        "2000,0.50,6.28,9,0.3\n"
        "\n"
        ",1.25,,,\n"
        ",2e0,,7,\n"
        "3000, 2 ,-3.14,,1.5\n",
        encoding="utf-8-sig",
    )
    np.testing.assert_array_equal(recorded.time, [500_000, 1_250_000, 2_000_000])
    np.testing.assert_array_equal(recorded.count, [2, 0, 1])
    np.testing.assert_array_equal(recorded.value, [[-0.2, 0.1, 1000], [0.3, 6.28, 2000], [1.5, -3.14, 3000]])
    assert recorded.label == ["0.5", "1.25", "2e0"]
    assert recorded.ignored == ("snr",)


def test_numbers_are_read_exactly(tmp_path):
    values = np.random.default_rng(0).uniform(0.1, 1.0, (50, 3))
    rows = "".join(f"{k},{','.join(map(repr, row))}\n" for k, row in enumerate(values.tolist()))
    np.testing.assert_array_equal(read(tmp_path, "time,elevation,bearing,range\n" + rows).value, values)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.3333333333", 333333),
        ("5e-7", 0),
        ("-12.25", -12_250_000),
        ("1600000000.123457", 1_600_000_000_123_457),
        ("8589934591.999999", 8_589_934_591_999_999),
        (" 7 ", 7_000_000),
    ],
)
def test_times_are_whole_microseconds_as_in_timedelta(text, expected):
    assert microseconds(text) == expected
    assert datetime.timedelta(microseconds=expected) == datetime.timedelta(seconds=float(text))


@pytest.mark.parametrize(
    ("rows", "line", "words"),
    [
        ("0,0.1,0.2\n", 2, "3 fields; expected 4"),
        ("0,0.1,0.2,5\n1\n", 3, "1 fields; expected 4; an empty scan is a time followed by empty fields"),
        ("0,0.1,0.2,5,6\n", 2, "5 fields; expected 4"),
        ("0,0.1,0.2,5\n\n\n0,x,0.2,5\n", 5, "elevation = 'x': expected a number"),
        ("0,0.1,0.2,1_000\n", 2, "range = '1_000': expected a number"),
        ("0,0.1,,5\n", 2, "bearing is empty; expected all of elevation, bearing, range or none"),
        ("0,,,5\n", 2, "elevation is empty"),
        ("0,0.1,0.2, \n", 2, "range is empty"),
        (",0.1,0.2,5\n", 2, "time = ''"),
        ("noon,0.1,0.2,5\n", 2, "time = 'noon': expected a number of s in"),
        ("nan,0.1,0.2,5\n", 2, "time = 'nan'"),
        ("inf,0.1,0.2,5\n", 2, "time = 'inf'"),
        ("1e400,0.1,0.2,5\n", 2, "time = '1e400'"),
        ("1600000000000,0.1,0.2,5\n", 2, "s in [-8.59e+09, 8.59e+09]; milliseconds by mistake?"),
        ("1,0.1,0.2,5\n0.5,0.1,0.2,5\n", 3, "time = 0.5: runs backwards, from 1"),
        ("0,nan,0.2,5\n", 2, "elevation = nan: expected rad in [-pi/2, pi/2]"),
        ("0,0.1,-inf,5\n", 2, "bearing = -inf: expected rad in [-pi, 2 pi]"),
        ("0,0.1,0.2,inf\n", 2, "range = inf: expected m in (0, inf)"),
        ("0,0.1,0.2,nan\n", 2, "range = nan"),
        ("0,0.1,0.2,0\n", 2, "range = 0.0: expected m in (0, inf)"),
        ("0,0.1,0.2,-5\n", 2, "range = -5.0"),
        ("0,1.58,0.2,5\n", 2, "elevation = 1.58: expected rad in [-pi/2, pi/2]; degrees by mistake?"),
        ("0,0.1,45,5\n", 2, "bearing = 45.0: expected rad in [-pi, 2 pi]; degrees by mistake?"),
        ("0,0.1,-3.2,5\n", 2, "bearing = -3.2"),
        ('0,0.1,0.2,"5\n', 2, "end of data"),
        ("", 1, "no rows below the header"),
    ],
)
def test_a_wrong_row_is_named_by_its_line(tmp_path, rows, line, words):
    with pytest.raises(ValueError, match="line") as caught:
        read(tmp_path, "time,elevation,bearing,range\n" + rows)
    assert str(caught.value).startswith(f"{tmp_path / 'detections.csv'}, line {line}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("", "no header; expected the columns time, elevation, bearing, range"),
        ("time,range\n", "no column elevation, bearing in the header 'time,range'"),
        ("0.5,0.1,0.2,100\n", "no column time, elevation, bearing, range"),
        ("time,elevation,bearing,range,time\n", "column time twice"),
    ],
)
def test_a_wrong_header_is_refused(tmp_path, header, words):
    with pytest.raises(ValueError, match="line 1: ") as caught:
        read(tmp_path, header)
    assert words in str(caught.value)


def test_edges_of_the_ranges_are_allowed(tmp_path):
    rows = f"0,{math.pi / 2!r},{2 * math.pi!r},1e-9\n0,{-math.pi / 2!r},{-math.pi!r},1e300\n"
    assert len(read(tmp_path, "time,elevation,bearing,range\n" + rows).value) == 2


def test_bytes_that_are_no_text_are_named_by_their_line(tmp_path):
    with pytest.raises(ValueError, match=r"line 2: elevation = .*: expected a number"):
        read(tmp_path, "time,elevation,bearing,range\n0,\xff,1,2\n", encoding="latin-1")


def test_no_such_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.csv"):
        read_detections(tmp_path / "nothing.csv")


def test_arrays_are_the_same_as_a_file(tmp_path):
    scans = [
        np.array([[0.1, 0.2, 100.0], [0.3, 0.4, 200.0]]),
        np.zeros((0, 3)),
        np.array([[0.5, 0.6, 300.0]]),
    ]
    ours = RecordedDetections.from_scans([0, 0.5, 1.75], scans)
    text = "time,elevation,bearing,range\n0,.1,.2,100\n0,.3,.4,200\n.5,,,\n1.75,.5,.6,300\n"
    theirs = read(tmp_path, text)
    for name in ("time", "count", "value"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


@pytest.mark.parametrize(
    ("times", "scans", "words"),
    [
        ([0, 1], [[]], "expected one for each of the 2 times"),
        ([0, 1, 1], [[], [], []], r"times\[2\] = 1: expected more than 1 s"),
        ([0, math.nan], [[], []], "time = 'nan'"),
        ([0, 1], [[], [[0.1, 90.0, 5.0]]], r"scans\[1\]: bearing = 90\.0"),
    ],
)
def test_wrong_arrays_are_refused(times, scans, words):
    with pytest.raises(ValueError, match=words):
        RecordedDetections.from_scans(times, scans)
