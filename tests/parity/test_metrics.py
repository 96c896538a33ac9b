"""`metrics` against GOSPAMetric and the covariance norm metrics."""

import jax
import numpy as np
import pytest
from stonesoup.measures import Euclidean
from stonesoup.metricgenerator.ospametric import GOSPAMetric
from stonesoup.metricgenerator.uncertaintymetric import (
    MeanofCovarianceNormsMetric,
    SumofCovarianceNormsMetric,
)

from jaxtrack import Params, Truths, metrics
from jaxtrack.types import POSITION
from reference.components import EPOCH
from reference.parity.compare import TOLERANCE
from reference.parity.scenes import AHEAD, random_means, random_tracks
from reference.translate import to_states, to_stone_soup_tracks

GOSPA = jax.jit(metrics.gospa)


def scene(rng, num_truths, num_tracks, spread):
    """Tracks around truths, with empty slots, dead truths and velocities that must not count."""
    towards = random_means(rng, 10, AHEAD)
    truths = Truths(towards, np.arange(10) < num_truths)
    tracks = random_tracks(rng, num_tracks, max_tracks=14)
    mean = towards[rng.permutation(10)[np.arange(14) % 10]] + spread * rng.standard_normal((14, 6))
    mean[:, 1::2] += 500.0
    return truths, tracks.replace(mean=np.asarray(mean))


@pytest.mark.parametrize(("num_truths", "num_tracks"), [(10, 14), (10, 4), (3, 9), (7, 0), (0, 5), (1, 1)])
@pytest.mark.parametrize(("cutoff", "order"), [(200.0, 2.0), (50.0, 1.0), (300.0, 3.0)])
def test_gospa(num_truths, num_tracks, cutoff, order):
    rng = np.random.default_rng(num_truths)
    params = Params(gospa_cutoff=cutoff, gospa_order=order)
    generator = GOSPAMetric(p=order, c=cutoff, measure=Euclidean(POSITION))
    for spread in (1.0, 60.0, 150.0):
        truths, tracks = scene(rng, num_truths, num_tracks, spread)
        states = [track.state for track in to_stone_soup_tracks(tracks, EPOCH)]
        theirs = generator.compute_gospa_metric(states, to_states(truths, EPOCH))[0].value
        ours = GOSPA(truths, tracks, params)
        for part in ("distance", "localisation", "missed", "false"):
            np.testing.assert_allclose(
                getattr(ours, part), theirs[part], rtol=TOLERANCE, atol=1e-9, err_msg=part
            )


def test_a_pair_at_the_cutoff_counts_as_missed_and_false():
    params = Params(gospa_cutoff=200.0)
    truths = Truths(np.array([[1000.0, 0, 0, 0, 0, 0]]), np.ones(1, dtype=bool))
    tracks = random_tracks(np.random.default_rng(1), 1)
    tracks = tracks.replace(mean=np.array([[1200.0, 0, 0, 0, 0, 0]]))
    generator = GOSPAMetric(p=2.0, c=200.0, measure=Euclidean(POSITION))
    states = [track.state for track in to_stone_soup_tracks(tracks, EPOCH)]
    theirs = generator.compute_gospa_metric(states, to_states(truths, EPOCH))[0].value
    ours = GOSPA(truths, tracks, params)
    assert (ours.localisation, ours.missed, ours.false) == (
        theirs["localisation"],
        theirs["missed"],
        theirs["false"],
    )
    assert ours.localisation == 0.0


@pytest.mark.parametrize("count", [1, 9])
def test_covariance_norms(count):
    tracks = random_tracks(np.random.default_rng(count), count, max_tracks=14)
    # What an empty slot holds must not count.
    tracks = tracks.replace(covariance=tracks.covariance.at[count:].set(7.0))
    states = [track.state for track in to_stone_soup_tracks(tracks, EPOCH)]
    total = SumofCovarianceNormsMetric().compute_covariancenorms(states).value
    mean = MeanofCovarianceNormsMetric().compute_covariancenorms(states).value
    np.testing.assert_allclose(metrics.covariance_norm_sum(tracks), total, rtol=TOLERANCE)
    np.testing.assert_allclose(metrics.covariance_norm_mean(tracks), mean, rtol=TOLERANCE)
