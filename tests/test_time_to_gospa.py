"""The time to a stated GOSPA: when training ends, and that the evaluation is that of `train.evaluate`."""

import dataclasses
from types import SimpleNamespace

import jax
import pytest

from benchmarks import time_to_gospa
from benchmarks.ppo import OurLearner, Seconds
from jaxtrack import Params, StaticParams
from jaxtrack.env import make
from train.agents import build_agent
from train.config import TrainConfig
from train.episodes import compare
from train.evaluate import COMPARED_SEED, agent

pytestmark = pytest.mark.usefixtures("quick_compilation")


def test_without_a_warm_start_the_rate_is_the_advised_one():
    assert time_to_gospa.configure(TrainConfig.warm_start, TrainConfig.total_steps, 0) == TrainConfig()
    alone = time_to_gospa.configure("none", 2_000_000, 3)
    assert alone == TrainConfig(warm_start="none", total_steps=2_000_000, seed=3, learning_rate=3e-3)


@pytest.mark.parametrize(("goal", "reached", "updates"), [(120.0, True, 3), (90.0, False, 4)])
def test_training_ends_at_the_first_evaluation_that_is_good_enough(monkeypatch, goal, reached, updates):
    config = TrainConfig(num_envs=2, rollout_steps=4, num_minibatches=1, total_steps=32)
    done = []

    def build(config, env):
        return OurLearner(SimpleNamespace(weights=0), lambda state: (done.append(1), {}), Seconds(1.0, 1.0))

    def evaluation(config, env, weights):
        other = {COMPARED_SEED: 130.0}
        return lambda weights, seed: other.get(seed, [200.0, 121.0, 119.0, 100.0][len(done) - 1])

    monkeypatch.setattr(time_to_gospa, "build_learner", build)
    monkeypatch.setattr(OurLearner, "__call__", lambda self: done.append(1))
    monkeypatch.setattr(time_to_gospa, "compile_evaluation", evaluation)
    found = time_to_gospa.train_until(goal, config)
    assert (found["reached"], len(done)) == (reached, updates)
    assert found["env_steps"] == 8 * updates
    assert [each["env_steps"] for each in found["evaluations"]] == [8, 16, 24, 32][:updates]
    assert found["gospa"] == [200.0, 121.0, 119.0, 100.0][updates - 1]
    assert found["gospa_on_other_scenarios"] == 130.0
    assert 0 < found["compile_seconds"] <= found["evaluations"][0]["seconds"] <= found["seconds"]


@pytest.mark.medium
def test_the_evaluation_is_that_of_train_evaluate():
    static = StaticParams(num_truths=2, max_tracks=3, max_detections=2, map_size=8, num_looks=5)
    static = dataclasses.replace(static, observe_variances=True)
    params = Params(max_steps_in_episode=12)
    config = TrainConfig(static=static, params=params)
    env, _ = make(params, static)
    keys = jax.random.split(jax.random.key(1), 2)
    observations = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)[0]
    beams = build_agent("beams", static, params)
    weights = beams.network.init(jax.random.key(0), jax.vmap(beams.features)(observations))
    evaluate = time_to_gospa.compile_evaluation(config, env, weights)
    competitor = agent(config, [weights], (0,))
    expected = compare({"beams": competitor}, env, params, time_to_gospa.EPISODES, seed=3).played["beams"]
    assert evaluate(weights, 3) == pytest.approx(expected.values["gospa"].mean(), rel=1e-5)
    assert evaluate(weights, 4) != evaluate(weights, 3)
