"""A run of tiny shapes whose training needs no compiling: every update adds one to all weights."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrack import StaticParams
from jaxtrack.env import SearchTrack
from train.checkpoint import learner_shapes, load_newest, save, updates
from train.config import TrainConfig
from train.metrics_file import CLOCK
from train.saved_run import write_config

STATIC = StaticParams(num_truths=2, max_tracks=3, max_detections=2, max_clutter=0, map_size=6, num_looks=3)
CONFIG = TrainConfig(
    num_envs=2,
    rollout_steps=2,
    num_minibatches=1,
    microbatch=4,
    total_steps=40,
    checkpoint_every=2,
    evaluation_episodes=0,
    seed=5,
    static=STATIC,
)
NAMES = ("policy_loss", "value_loss", "gradient_norm", "reward", "episode_return", "completeness")

OPTIONS = {
    "num-envs": 4,
    "rollout-steps": 8,
    "num-minibatches": 2,
    "microbatch": 8,
    "epochs": 1,
    "static.num-truths": 2,
    "static.max-tracks": 3,
    "static.max-detections": 2,
    "static.max-clutter": 0,
    "static.map-size": 6,
    "static.num-looks": 3,
    "params.max-steps-in-episode": 6,
    "params.beam-azimuth": 0.9,
    "params.beam-elevation": 0.9,
}
"""Options of a run that is really trained, in milliseconds per update."""


def random_state():
    """A learner whose arrays all hold different random numbers, without compiling its start."""
    shapes = learner_shapes(SearchTrack(STATIC), CONFIG)
    rng = np.random.default_rng(0)

    def draw(leaf):
        if leaf.dtype == bool:
            return jnp.asarray(rng.integers(2, size=leaf.shape), bool)
        if jnp.issubdtype(leaf.dtype, jnp.integer):
            return jnp.asarray(rng.integers(1, 1 << 20, leaf.shape), leaf.dtype)
        return jnp.asarray(9 * rng.normal(size=leaf.shape), leaf.dtype)

    return jax.tree.map(draw, shapes)


def at(state, update):
    """The state of an update; each has other weights."""
    weights = jax.tree.map(lambda leaf: leaf + update, state.weights)
    return state.replace(update=jnp.asarray(update), weights=weights)


def step(state):
    """An update of the made-up training."""
    after = state.replace(weights=jax.tree.map(lambda leaf: leaf + 1, state.weights), update=state.update + 1)
    leaf = jax.tree.leaves(after.weights)[0].sum()
    metrics = {name: leaf * (number + 1) for number, name in enumerate(NAMES)}
    return after, {**metrics, "covariance_norm_mean": jnp.asarray(jnp.nan)}


def write_run(folder, state, written=(1,)):
    """A run's folder with checkpoints of these updates."""
    write_config(folder, CONFIG)
    for update in written:
        save(folder, at(state, update), CONFIG, f"rows up to {update}")
    return updates(folder)


def assert_same(one, other):
    """Two trees, bit for bit."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b, strict=True)


def without_clock(folder):
    """The cells of metrics.csv without the columns that no two runs share."""
    lines = [line.split(",") for line in (folder / "metrics.csv").read_text().splitlines()]
    kept = [place for place, name in enumerate(lines[0]) if name not in CLOCK]
    return [[cells[place] for place in kept] for cells in lines]


def assert_same_result(folder, reference):
    """Bit for bit: the whole last learner state, and the metrics but for the clock's columns."""
    assert_same(*(load_newest(each).arrays for each in (folder, reference)))
    assert without_clock(folder) == without_clock(reference)
