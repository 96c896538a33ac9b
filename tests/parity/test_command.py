"""`python -m reference.parity`: its table, its verdict, and what it says of a first difference."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxtrack import Params
from reference.parity import __main__ as command
from reference.parity import free_running, oracle, ours, stepwise
from reference.parity.compare import TOLERANCE, exact_mahalanobis
from reference.parity.episodes import Comparison, Divergence, EpisodeTallies, compare_episode, is_tied
from reference.parity.rows import Row, Tally
from reference.parity.scenarios import KINDS, random_scenario
from reference.parity.table import BEGIN, END, cells, write_readme
from reference.parity.written import line_below, results, table_of

pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 40
TABLE_FROM_THE_PAPER = [
    "KalmanPredictor",
    "UnscentedKalmanUpdater",
    "DistanceHypothesiser",
    "DistanceGater",
    "NearestNeighbour",
    "SimpleMeasurementInitiator",
    "CovarianceBasedDeleter",
    "MultiTargetTracker",
    "Mahalanobis",
    "Euclidean",
    "KLDivergence",
    "GaussianHellinger",
    "SumofCovarianceNorms",
    "GOSPAMetric",
    "SIAPMetrics",
    "BasicMetrics",
    "PCRBMetric",
    "MultiTargetGroundTruthSimulator",
    "FixedPlatform",
    "RadarRotatingElevationBearingRange",
    "Gymnasium",
]
OTHER_PARTS = [
    "ExtendedKalmanUpdater",
    "CubatureKalmanUpdater",
    "KalmanUpdater with a LinearGaussian",
    "SqrtKalmanUpdater by QR, SqrtKalmanPredictor",
    "SqrtKalmanUpdater with a LinearGaussian",
    "GNNWith2DAssignment",
    "UpdateTimeDeleter",
    "UpdateTimeStepsDeleter",
    "CompositeDeleter",
    "MultiMeasurementInitiator",
]


@pytest.mark.medium
def test_the_quick_run(tmp_path, capsys):
    """Everything that the full run does, in small."""
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{BEGIN}\nstale table\n{END}\nafter\n")
    out = tmp_path / "parity.json"
    code = command.main(["--quick", "--processes", "1", "--out", str(out), "--readme", str(readme)])
    found = json.loads(out.read_text())
    assert code == 0, capsys.readouterr().out
    assert found["divergences"] == []
    assert all(row["passed"] for row in found["rows"])
    # What is said to be in single precision, or by finite differences, is.
    for row in found["rows"]:
        assert row["float32"] is None or row["float32"] > 1e-9, row
        assert row["stock"] is None or row["stock"] > 1e-9, row
    table = readme.read_text()
    assert table.startswith("before\n")
    assert table.endswith("after\n")
    assert "stale" not in table
    for name in TABLE_FROM_THE_PAPER + OTHER_PARTS:
        assert any(name in row["stone_soup"] for row in found["rows"]), name
        assert name in table
    assert found["options"]["episodes"] == command.QUICK["episodes"]
    assert found["versions"]["stonesoup"] == "1.9.1"


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--seed", "-1"], ["--out", "/no/such/folder/x"]])
def test_wrong_options_are_named_before_anything_is_computed(arguments):
    with pytest.raises(ValueError, match=f"{arguments[0].removeprefix('--')} = "):
        command.main(arguments)


def test_random_scenarios_hold_what_they_promise():
    """Wraps, births and deaths of truths, clutter, misses and empty scans, among few of them."""
    scenarios = [random_scenario(seed, STEPS) for seed in range(15)]
    assert {scenario.kind for scenario in scenarios} == set(KINDS)
    bearings = np.concatenate([s.detections.value[..., 1][s.detections.active] for s in scenarios])
    elevations = np.concatenate([s.detections.value[..., 0][s.detections.active] for s in scenarios])
    assert bearings.max() > 3.1
    assert bearings.min() < -3.1
    assert np.abs(elevations).max() > 1.5
    assert len({s.truths.alive.shape[1] for s in scenarios}) > 3
    assert any((s.detections.truth[s.detections.active] < 0).any() for s in scenarios)
    assert any(not s.truths.alive.all() for s in scenarios)
    assert all((~s.detections.active).all(axis=1).any() for s in scenarios)


@pytest.fixture(scope="module")
def played():
    """One scenario on both sides."""
    scenario = random_scenario(15, STEPS)
    return scenario, oracle.run(oracle.Job(scenario)), *ours.episode(scenario)


def test_equal_episodes_have_no_divergence(played):
    scenario, records, tracks, info = played
    found = compare_episode(records, tracks, info, scenario.detections.active, scenario.params, TOLERANCE)
    assert found.divergence is None
    assert found.steps == STEPS
    assert min(found.updates, found.births, found.deletions) > 5


def changed(records, step, **fields):
    return [*records[:step], dataclasses.replace(records[step], **fields), *records[step + 1 :]]


def first(records, kind):
    """First step on which something of a kind happened, and to which track."""
    return next((k, sorted(getattr(r, kind))[0]) for k, r in enumerate(records) if getattr(r, kind))


@pytest.mark.parametrize(
    ("kind", "quantity"),
    [("associated", "associated detection"), ("deleted", "deleted"), ("initiated", "initiated")],
)
def test_a_different_decision_is_named(played, kind, quantity):
    scenario, records, tracks, info = played
    step, key = first(records, kind)
    without = (
        {k: v for k, v in getattr(records[step], kind).items() if k != key}
        if kind == "associated"
        else (getattr(records[step], kind) - {key})
    )
    found = compare_episode(
        changed(records, step, **{kind: without}),
        tracks,
        info,
        scenario.detections.active,
        scenario.params,
        1e-9,
    )
    divergence = found.divergence
    assert (divergence.step, divergence.track, divergence.quantity) == (step + 1, key, quantity)
    assert divergence.ours != divergence.theirs
    assert f"step {step + 1}, track born on step {key[0]} from {key[1]}: {quantity}" in str(divergence)


@pytest.mark.parametrize(
    ("kind", "quantity"),
    [("associated", "associated detection"), ("deleted", "deleted"), ("initiated", "initiated")],
)
def test_a_decision_that_only_stone_soup_takes_is_named(played, kind, quantity):
    scenario, records, tracks, info = played
    spared = ((k, sorted(r.updated.keys() - r.associated.keys() - r.deleted)) for k, r in enumerate(records))
    step, key = next((k, keys[0]) for k, keys in spared if keys)
    more = (
        {**records[step].associated, key: 0} if kind == "associated" else getattr(records[step], kind) | {key}
    )
    records = changed(records, step, **{kind: more})
    divergence = compare_episode(
        records, tracks, info, scenario.detections.active, scenario.params, TOLERANCE
    ).divergence
    assert (divergence.step, divergence.track, divergence.quantity) == (step + 1, key, quantity)


def test_an_estimate_that_is_not_a_number_diverges(played):
    scenario, records, tracks, info = played
    step, key = first(records, "live")
    nan = dataclasses.replace(records[step].live[key], mean=np.full(6, np.nan))
    records = changed(records, step, live={**records[step].live, key: nan})
    found = compare_episode(records, tracks, info, scenario.detections.active, scenario.params, TOLERANCE)
    assert (found.divergence.step, found.divergence.track) == (step + 1, key)


@pytest.mark.parametrize("newborn", [True, False])
def test_errors_of_newborns_are_kept_apart(played, newborn):
    scenario, records, tracks, info = played
    lists = ((k, sorted(r.initiated if newborn else r.associated)) for k, r in enumerate(records))
    step, key = next((k, keys[0]) for k, keys in lists if keys)
    estimate = records[step].live[key]
    off = dataclasses.replace(estimate, covariance=estimate.covariance * (1 + 1e-6))
    records = changed(records, step, live={**records[step].live, key: off})
    found = compare_episode(records, tracks, info, scenario.detections.active, scenario.params, 1e-3)
    assert found.divergence is None
    assert found.error > 1e-7
    assert (found.birth_error > 1e-7) is newborn


@pytest.mark.parametrize(
    ("distances", "tied"),
    [
        pytest.param([[1, 1], [2, 9]], True, id="two detections for one track"),
        pytest.param([[1, 2], [1, 9]], True, id="two tracks for one detection"),
        pytest.param([[1, 2], [9, 1 + 1e-9]], False, id="nearly"),
        pytest.param([[1, 9], [9, 1]], False, id="equal, but of other tracks and detections"),
        pytest.param([[4, 4], [9, 9]], False, id="beyond the missed distance"),
        pytest.param([[np.nan, np.nan], [1, 2]], False, id="no distances"),
    ],
)
def test_ties_are_equal_distances_of_pairs_that_compete(distances, tied):
    params = Params(gate_threshold=5.0, missed_distance=3.0)
    # A third track and a third detection that do not exist are as near as can be.
    table = np.zeros((3, 3))
    table[:2, :2] = distances
    there = np.array([True, True, False])
    info = SimpleNamespace(distances=table, predicted=SimpleNamespace(active=there))
    assert is_tied(info, there, params) is tied


def test_a_divergence_is_a_decision_that_disagrees():
    tallies = EpisodeTallies()
    assert np.isnan(tallies.agreement)
    tallies.add(3, Comparison(steps=5, updates=1, births=2))
    assert tallies.agreement == 1
    tallies.add(4, Comparison(steps=2, divergence=Divergence(3, None, "live", True, False)))
    assert tallies.agreement == 3 / 4
    assert [number for number, _ in tallies.divergences] == [4]


def test_every_variant_of_an_episode_has_its_own_figures(monkeypatch):
    """Ours in both precisions against the exact oracle, in double precision against the bare one."""
    variants = {(True, True): 1, (True, False): 2, (False, True): 3}

    def compare(_, exact_jacobian, is_double, tolerance):
        assert (tolerance == TOLERANCE) is (exact_jacobian and is_double)
        size = variants[exact_jacobian, is_double]
        divergence = Divergence(1, None, "x", 0, 1)
        return Comparison(
            steps=5,
            births=size,
            mean_error=size,
            birth_error=10 * size,
            tie=False,
            divergence=divergence,
        )

    monkeypatch.setattr(free_running, "run_all", lambda jobs, _: [job.exact_jacobian for job in jobs])
    monkeypatch.setattr(free_running, "compare", compare)
    rows, lines = free_running.free_running_rows(range(2), 1, 1, lambda items, *_: items)
    assert [(row.float64, row.float32, row.stock) for row in rows] == [(10, 20, 30), (1, 2, 3)]
    agreements = rows[1].agreement, rows[1].agreement32, rows[1].agreement_stock
    assert agreements == (1 / 2, 2 / 3, 3 / 4)
    # Births of the two episodes of the first variant, and steps.
    assert [row.compared for row in rows] == [2, 10]
    kinds = ("", " (float32)", " (stock initiator)")
    assert lines == [f"episode {n}{kind}: step 1: x ours 0, Stone Soup 1" for kind in kinds for n in (0, 1)]


@pytest.fixture(scope="module")
def stepped(played):
    """The first steps of the scenario, with the oracle's intermediates."""
    scenario, *_ = played
    short = dataclasses.replace(
        scenario, detections=jax.tree.map(lambda leaf: leaf[:STEPWISE], scenario.detections)
    )
    records = oracle.run(oracle.Job(short, intermediates=True))
    return short, records, oracle.tracks_before(records, ours.MAX_TRACKS)


STEPWISE = 15


def flagged(scenario, records, before):
    """Components that do not pass."""
    tallies = stepwise.Tallies(Tally)
    stepwise.compare_steps(scenario, records, before, True, tallies)
    tolerance = {key: stepwise.EXCEPTIONS.get(key, (TOLERANCE, ""))[0] for key in stepwise.COMPONENTS}
    rows = {key: tallies[key].row(key, "", "", tolerance=tolerance[key]) for key in tolerance}
    return {key for key, row in rows.items() if not row.passed}


def slightly(value):
    return value * (1 + 1e-5)


@pytest.mark.parametrize(
    ("kind", "change", "components"),
    [
        pytest.param("expected", {}, set(), id="nothing"),
        pytest.param("expected", {"mean": slightly}, {"predict"}, id="predicted mean"),
        pytest.param("expected", {"covariance": slightly}, {"predict"}, id="predicted covariance"),
        pytest.param(
            "expected", {"detection_mean": slightly}, {"expect", "measure"}, id="expected detection"
        ),
        pytest.param("expected", {"detection_covariance": slightly}, {"expect", "measure"}, id="S"),
        pytest.param("expected", {"cross_covariance": slightly}, {"expect"}, id="cross covariance"),
        pytest.param("expected", {"distances": slightly}, {"pinv"}, id="distances"),
        pytest.param("expected", {"admissible": np.logical_not}, {"gate"}, id="gate"),
        pytest.param("updated", {"mean": slightly}, {"update"}, id="updated mean"),
        pytest.param("updated", {"covariance": slightly}, {"update"}, id="updated covariance"),
        pytest.param("live", {"mean": slightly}, {"initiate", "step"}, id="mean at the end"),
        pytest.param("live", {"covariance": slightly}, {"initiate", "step"}, id="covariance at the end"),
        pytest.param("associated", None, {"associate", "update", "step"}, id="associations"),
        pytest.param("deleted", None, {"delete", "step"}, id="deletions"),
        pytest.param("initiated", None, {"initiate"}, id="births"),
    ],
)
def test_every_intermediate_is_compared(stepped, kind, change, components):
    scenario, records, before = stepped

    def wrong(record):
        entries = getattr(record, kind)
        if change is None:
            return dataclasses.replace(record, **{kind: type(entries)()})
        other = {
            key: dataclasses.replace(
                entry, **{name: off(getattr(entry, name)) for name, off in change.items()}
            )
            for key, entry in entries.items()
        }
        return dataclasses.replace(record, **{kind: other})

    assert flagged(scenario, [wrong(record) for record in records], before) == components


@pytest.mark.parametrize("quantity", ["mean", "covariance"])
def test_a_different_estimate_is_named_with_both_values(played, quantity):
    scenario, records, tracks, info = played
    step, key = first(records, "live")
    estimate = records[step].live[key]
    off = dataclasses.replace(estimate, **{quantity: getattr(estimate, quantity) * (1 + 1e-6)})
    records = changed(records, step, live={**records[step].live, key: off})
    divergence = compare_episode(
        records, tracks, info, scenario.detections.active, scenario.params, TOLERANCE
    ).divergence
    assert (divergence.step, divergence.track) == (step + 1, key)
    assert divergence.quantity.startswith(quantity)
    assert np.any(divergence.ours != divergence.theirs)


def test_exact_ties_end_a_comparison_and_are_counted(played):
    """Every detection twice: two tracks are born in one place, and compete for what follows."""
    scenario, *_ = played
    detections = jax.tree.map(
        lambda leaf: np.concatenate([leaf[:, :8], leaf[:, :8]], axis=1), scenario.detections
    )
    twice = dataclasses.replace(scenario, detections=detections)
    records = oracle.run(oracle.Job(twice))
    found = compare_episode(records, *ours.episode(twice), twice.detections.active, twice.params, TOLERANCE)
    assert found.tie
    assert found.divergence is None
    assert found.steps < STEPS
    tallies = EpisodeTallies()
    tallies.add(0, found)
    assert tallies.ties == 1
    # What differed before the tie is not excused by it.
    step, _ = first(records, "initiated")
    wrong = changed(records, step, initiated=set())
    found = compare_episode(wrong, *ours.episode(twice), twice.detections.active, twice.params, TOLERANCE)
    assert found.divergence.quantity == "initiated"
    assert not found.tie


def test_oracles_in_processes_give_the_same(played):
    scenario, records, *_ = played
    short = dataclasses.replace(scenario, detections=jax.tree.map(lambda leaf: leaf[:5], scenario.detections))
    (found,) = oracle.run_all([oracle.Job(short)], processes=2)
    for mine, theirs in zip(found, records[:5], strict=True):
        assert mine.live.keys() == theirs.live.keys()
        assert mine.associated == theirs.associated


def test_exact_distances_are_those_of_the_formula():
    S = np.array([[2e-6, 1e-6, 1e-4], [1e-6, 3e-6, -2e-4], [1e-4, -2e-4, 5.0]])
    mean, value = np.array([1.5, 3.1, 1000.0]), np.array([[1.5 + 1e-3, -3.1, 1001.0]])
    d = np.array([-1e-3, 6.2 - 2 * np.pi, -1.0])
    np.testing.assert_allclose(
        exact_mahalanobis(mean, S, value), np.sqrt(d @ np.linalg.solve(S, d)), rtol=1e-9
    )


GOOD = Row("a", "b", 10, "steps", 1e-12, agreement=1.0)


@pytest.mark.parametrize(
    ("fields", "passed"),
    [
        ({}, True),
        ({"float64": 2e-9}, False),
        ({"float64": float("nan")}, False),
        ({"agreement": 0.9999}, False),
        ({"compared": 0}, False),
        ({"float64": None}, True),
        ({"float64": None, "agreement": None}, False),
        ({"float64": 2e-9, "tolerance": 1e-6}, True),
    ],
)
def test_a_row_passes_only_if_all_of_it_does(fields, passed):
    assert dataclasses.replace(GOOD, **fields).passed is passed


def test_nearly_all_is_not_printed_as_all():
    assert cells(dataclasses.replace(GOOD, agreement=1 - 1e-9))[-1] == "99.9999 %"
    assert cells(GOOD)[-1] == "100 %"


def test_a_tally_keeps_nan():
    tally = Tally()
    for error in (1.0, float("nan"), 2.0):
        tally.error(error)
    assert np.isnan(tally.largest)
    assert not tally.row("a", "b", "steps").passed


def test_a_readme_without_marks_is_refused(tmp_path):
    path = tmp_path / "README.md"
    path.write_text("nothing")
    with pytest.raises(ValueError, match="expected the marks"):
        write_readme(path, [GOOD], "below")
    assert path.read_text() == "nothing"


ONLY = "lifecycle.is_missed_long"
TINY = ["--only", ONLY, "--part-episodes", "1", "--steps", "12", "--processes", "1"]
LINES = [
    "UpdateTimeDeleter, scenario 3: of before",
    "UpdateTimeStepsDeleter, scenario 3: step 1",
    "environment: step 2",
]


@pytest.fixture
def written(tmp_path):
    """Results of a whole run with the sizes of `TINY`, in which the row to be replaced fails, and a page."""
    asked = command.asked(command.ParityOptions(part_episodes=1, steps=12))
    stale = dataclasses.replace(GOOD, component=ONLY, agreement=0.5)
    rows = [dataclasses.replace(GOOD, note="first"), stale, dataclasses.replace(GOOD, component="last")]
    out, readme = tmp_path / "parity.json", tmp_path / "README.md"
    out.write_text(json.dumps(results(asked, rows, LINES, 60.0)))
    readme.write_text(f"{BEGIN}\nstale table\n{END}")
    return out, readme


def test_one_row_measured_again_replaces_its_own(written, capsys):
    out, readme = written
    before = json.loads(out.read_text())
    options = [*TINY, "--out", str(out), "--readme", str(readme)]
    assert command.main(options) == 0, capsys.readouterr().out
    found = json.loads(out.read_text())
    (again,) = found.pop("again")
    assert again["component"] == ONLY
    assert again["seconds"] < 60
    row = found["rows"][1]
    assert (row["stone_soup"], row["compared"], row["passed"]) == (
        "UpdateTimeDeleter, 1 whole episodes",
        12,
        True,
    )
    # All else is as it was.
    before["rows"][1] = row
    before["divergences"] = LINES[1:]
    assert found == before
    table = readme.read_text()
    assert [line.split("|")[1].strip() for line in table.splitlines() if line.startswith("| `")] == [
        "`a`",
        f"`{ONLY}`",
        "`last`",
    ]
    assert "* `a` (b): first." in table
    assert "2,640 steps one by one, 1,000 whole episodes; python" in table
    assert f"1 min; `{ONLY}` again {again['date'][:10]}." in table
    # A second time, in place of the first.
    assert command.main(options) == 0
    assert len(json.loads(out.read_text())["again"]) == 1


def test_divergences_of_a_row_measured_again_come_before_those_of_the_environment(written, monkeypatch):
    out, _ = written
    failed = dataclasses.replace(GOOD, component=ONLY, agreement=0.9)
    new = "UpdateTimeDeleter, scenario 0: of now"
    monkeypatch.setattr(command, "part_rows", lambda parts, *_: ([failed], [new]))
    assert command.main([*TINY, "--out", str(out)]) == 1
    found = json.loads(out.read_text())
    assert found["divergences"] == [LINES[1], new, LINES[2]]
    assert not found["rows"][1]["passed"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--only", "tracker.step"], "only = 'tracker.step': expected one of kalman.predict_detections_ext"),
        ([*TINY, "--steps", "13"], "steps = 13: .*parity.json was measured with 12"),
        (["--only", "lifecycle.take_over", *TINY[2:]], "it has no row of lifecycle.take_over"),
        ([*TINY, "--out", "nothing.json"], "out = 'nothing.json': expected the results of a whole run"),
    ],
    ids=["no such part", "other options", "no such row", "no results"],
)
def test_a_row_is_put_only_where_it_belongs(written, arguments, said, monkeypatch):
    out, _ = written
    monkeypatch.chdir(out.parent)
    before = out.read_text()
    with pytest.raises(ValueError, match=said):
        command.main(["--out", str(out), *arguments])
    assert out.read_text() == before


@pytest.mark.parametrize("text", ["{}", "[]", "no JSON", '{"rows": [1], "options": {}, "versions": {}}'])
def test_a_row_needs_results_of_a_whole_run(written, text):
    out, _ = written
    out.write_text(text)
    with pytest.raises(ValueError, match="expected the results of a whole run"):
        command.main([*TINY, "--out", str(out)])


def test_a_row_is_not_put_beside_those_of_other_versions(written):
    out, _ = written
    found = json.loads(out.read_text())
    found["versions"]["stonesoup"] = "1.0"
    out.write_text(json.dumps(found))
    with pytest.raises(ValueError, match=r"stonesoup = 1.9.1: .*parity.json was measured with 1.0"):
        command.main([*TINY, "--out", str(out)])


def test_the_published_table_is_that_of_the_published_results(tmp_path):
    root = Path(__file__).parents[2]
    found = json.loads((root / "docs/parity.json").read_text())
    page = tmp_path / "README.md"
    page.write_text((root / "README.md").read_text())
    write_readme(page, table_of(found), line_below(found))
    assert page.read_text() == (root / "README.md").read_text()
    assert all(row.passed for row in table_of(found))
