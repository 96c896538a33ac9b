"""`kalman.predict` against KalmanPredictor of a combined ConstantVelocity model."""

import datetime

import jax
import numpy as np
import pytest
from stonesoup.types.state import GaussianState

from jaxtrack import NO_DETECTION, Params, kalman, models
from reference.components import build_components, transition_model
from reference.parity.compare import TOLERANCE, covariance_error, mean_error
from reference.parity.scenes import random_covariances, random_means, track_list
from reference.translate import as_vector

TIME_STEPS = [0.005, 0.05, 1.0, 10.0]


@pytest.mark.parametrize("time_step", TIME_STEPS)
@pytest.mark.parametrize("process_noise", [0.0, 1.0, 25.0])
def test_transition_and_noise_matrices(time_step, process_noise):
    F, Q = models.constant_velocity(time_step, process_noise)
    theirs = transition_model(process_noise)
    interval = datetime.timedelta(seconds=time_step)
    np.testing.assert_allclose(F, theirs.matrix(time_interval=interval), rtol=1e-15)
    np.testing.assert_allclose(Q, theirs.covar(time_interval=interval), rtol=1e-15)


@pytest.mark.parametrize("time_step", TIME_STEPS)
def test_prediction(time_step):
    rng = np.random.default_rng(1)
    params = Params(time_step=time_step, process_noise=3.0)
    mean, covariance = random_means(rng, 20, (0.0, 0.0)), random_covariances(rng, 20)
    ours = jax.jit(kalman.predict)(track_list(mean, covariance), time_step, params)
    now = datetime.datetime(2000, 1, 1)
    later = now + datetime.timedelta(seconds=time_step)
    predictor = build_components(params).predictor
    for slot in range(20):
        prior = GaussianState(mean[slot], covariance[slot], timestamp=now)
        theirs = predictor.predict(prior, timestamp=later)
        assert mean_error(ours.mean[slot], as_vector(theirs.state_vector), theirs.covar) <= TOLERANCE
        assert covariance_error(ours.covariance[slot], theirs.covar) <= TOLERANCE
    np.testing.assert_array_equal(ours.age, 1)
    np.testing.assert_array_equal(ours.updated_by, NO_DETECTION)
