"""The numbers of the comparison of policies against Stone Soup's generators on the same episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from jaxtrack.env import SearchTrack
from jaxtrack.policies import POLICIES
from reference.parity.records import Record
from reference.parity.stock_metrics import (
    GOSPA_PARTS,
    SIAP_CONTINUITY,
    SIAP_RATIOS,
    StockRecord,
    stock_basic,
    stock_gospa,
    stock_norms,
    stock_siap,
)
from train import episodes
from train.episodes import play_episodes

TOLERANCE = 1e-6
LENGTH, EPISODES = 60, 3
STATIC = StaticParams(
    num_truths=4, max_tracks=8, max_detections=6, max_clutter=2, map_size=8, num_looks=4, reward="information"
)
# Truths near each other and near the radar, false detections and few looks at each place: tracks
# break, change hands, and follow none.
PARAMS = Params(
    max_steps_in_episode=LENGTH,
    time_step=0.1,
    beam_azimuth=0.7,
    beam_elevation=0.7,
    max_range=1500.0,
    clutter_rate=0.1,
    detection_probability=0.8,
    deletion_threshold=3000.0,
    gate_threshold=2.0,
    missed_distance=2.0,
)
CHOSEN = ("index", "random")


@pytest.fixture(scope="module")
def ours_and_theirs():
    """Every policy's and every episode's metrics of ours `[E]`, with the records that Stone Soup gets."""
    env = SearchTrack(STATIC)

    @jax.jit
    def play(keys, which):
        policies = [POLICIES[name](STATIC, PARAMS) for name in CHOSEN]

        def act(key, state):
            return jax.lax.switch(which, policies, key, state)

        return play_episodes(keys, act, env, PARAMS, LENGTH)

    right_row, right_values = episodes.step_row, episodes.episode_values
    with pytest.MonkeyPatch.context() as patch:
        # What is measured stays as it is; the truths and whole tracks it was measured on come along.
        patch.setattr(
            episodes,
            "step_row",
            lambda before, after, *others: right_row(before, after, *others).replace(tracks=after.tracks),
        )
        patch.setattr(
            episodes,
            "episode_values",
            lambda rows, params: right_values(rows, params) | {"record": (rows.truths, rows.tracks)},
        )
        keys = jax.random.split(jax.random.key(12), EPISODES)
        played = [jax.device_get(play(keys, jnp.asarray(which)))[:2] for which in range(len(CHOSEN))]
    found = []
    for values, curves in played:
        for episode in range(EPISODES):
            own, own_curves = jax.tree.map(lambda leaf, e=episode: leaf[e], (values, curves))
            found.append((own, own_curves, StockRecord(Record(PARAMS, *own.pop("record")))))
    return found


pytestmark = pytest.mark.usefixtures("quick_compilation")


def check(ours, theirs, name):
    assert ours.dtype == np.float64
    np.testing.assert_allclose(ours, theirs, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)


def test_gospa(ours_and_theirs):
    for values, curves, stock in ours_and_theirs:
        theirs = stock_gospa(stock)
        for part in GOSPA_PARTS[:4]:
            name = "gospa" if part == "distance" else f"gospa_{part}"
            check(curves[name], theirs[part], name)
            check(values[name], theirs[part].mean(), name)


def test_covariance_norms(ours_and_theirs):
    for values, curves, stock in ours_and_theirs:
        theirs = stock_norms(stock)
        # Stone Soup has no number on a step without a track.
        check(curves["covariance_norm"], theirs["mean"], "covariance norm")
        check(values["covariance_norm_when_tracking"], np.nanmean(theirs["mean"]), "steps with a track")
        check(values["covariance_norm_mean"], np.nan_to_num(theirs["mean"]).mean(), "mean")
        check(values["covariance_norm_sum"], np.nan_to_num(theirs["sum"]).mean(), "sum")


def test_track_to_target_ratio(ours_and_theirs):
    for values, _, stock in ours_and_theirs:
        theirs = stock_basic(stock)
        check(values["track_to_target_ratio"], theirs["track_to_target_ratio"], "ratio")
        alive = stock.record.truths.alive.sum(axis=1)
        check(
            values["mean_track_to_target_ratio"],
            (stock.record.tracks.active.sum(axis=1) / alive).mean(),
            "mean",
        )


def test_siap(ours_and_theirs):
    for values, _, stock in ours_and_theirs:
        theirs = stock_siap(stock)
        assert np.isfinite(theirs["track_change_rate"])
        for name in SIAP_RATIOS | SIAP_CONTINUITY:
            check(values[f"siap_{name}"], theirs[name], name)


def test_these_episodes_tell_the_metrics_apart(ours_and_theirs):
    def largest(name):
        return max(float(values[name]) for values, *_ in ours_and_theirs)

    for name in ("gospa_false", "siap_spuriousness", "siap_track_change_rate", "track_breaks"):
        assert largest(name) > 0, name
    assert largest("siap_ambiguity") > 1
    assert any(np.isnan(curves["covariance_norm"]).any() for _, curves, _ in ours_and_theirs)
    assert len({float(values["siap_completeness"]) for values, *_ in ours_and_theirs}) == 2 * EPISODES
