"""The actor-critic of the paper: structure, initialisation, and that it can learn."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxtrack import Params, StaticParams
from train.beams import BeamGeometry
from train.distributions import FACTORED
from train.networks import ENCODERS, PaperNetwork

pytestmark = pytest.mark.usefixtures("quick_compilation")

B, T, L = 6, 5, 19


@pytest.fixture(scope="module")
def observation():
    keys = jax.random.split(jax.random.key(0), 3)
    mask = jax.random.bernoulli(keys[1], 0.5, (B, T)).at[0].set(False)
    return {
        "tracks": jnp.where(mask[..., None], jax.random.normal(keys[0], (B, T, 7)), 0.0),
        "mask": mask,
        "scan_map": jax.random.uniform(keys[2], (B, 48, 48)),
    }


@pytest.fixture(scope="module", params=list(ENCODERS))
def network(request, observation, draw_variables):
    """A network of every kind with variables drawn cheaply."""
    network = PaperNetwork(request.param)
    return network, draw_variables(network, observation)


@pytest.fixture(scope="module")
def initialised(observation):
    """A network with its own initialisation."""
    network = PaperNetwork("mhsa")
    return network, jax.jit(network.init)(jax.random.key(1), observation)


def test_shapes_and_dtypes(apply, network, observation):
    network, variables = network
    logits, value = apply(network, variables, observation)
    assert logits.shape == (B, 2, L)
    assert value.shape == (B,)
    assert logits.dtype == value.dtype == jnp.float32


def test_the_first_policy_is_nearly_uniform(apply, initialised, observation):
    network, variables = initialised
    logits, value = apply(network, variables, observation)
    np.testing.assert_allclose(FACTORED.entropy(logits), 2 * np.log(L), atol=1e-3)
    assert np.std(logits) > 1e-5
    assert np.std(value) > 1e-2


def test_vmap_over_single_observations_is_the_batch(apply, initialised, observation):
    network, variables = initialised

    @jax.jit
    @jax.vmap
    def single(observation):
        one = jax.tree.map(lambda x: x[None], observation)
        return jax.tree.map(lambda x: x[0], network.apply(variables, one))

    batch = apply(network, variables, observation)
    for got, expected in zip(single(observation), batch, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_features_are_shared_and_the_two_mlps_are_not(apply, network, observation):
    """As in SB3's MultiInputPolicy: only the feature extractors serve both outputs."""
    network, variables = network
    before = apply(network, variables, observation)

    def outputs_that_depend_on(part):
        changed = variables["params"] | {part: jax.tree.map(lambda x: 1.5 * x, variables["params"][part])}
        after = apply(network, {"params": changed}, observation)
        return [not np.allclose(a, b) for a, b in zip(after, before, strict=True)]

    assert set(variables["params"]) == {"scan_map", "track_list", "policy", "value"}
    assert outputs_that_depend_on("scan_map") == [True, True]
    assert outputs_that_depend_on("track_list") == [True, True]
    assert outputs_that_depend_on("policy") == [True, False]
    assert outputs_that_depend_on("value") == [False, True]


def test_a_joint_head_has_a_logit_for_every_look(observation):
    network = PaperNetwork("flatten", head="joint")
    logits, value = jax.eval_shape(
        lambda key: network.init_with_output(key, observation)[0], jax.random.key(0)
    )
    assert (logits.shape, value.shape) == ((B, L * L), (B,))


def test_the_beams_head_tells_what_lies_in_each_beam(apply, observation, draw_variables):
    """Looks with the same in their beams have the same logit; a track changes those of its beams alone."""
    static, params = StaticParams(max_tracks=T, num_looks=L), Params()
    network = PaperNetwork("flatten", head="beams")
    tracks = jnp.abs(observation["tracks"]) / 3  # a covariance has no negative norm
    whole = {**observation, "tracks": tracks, "mask": jnp.ones((B, T), bool)}
    beams = jax.jit(jax.vmap(BeamGeometry(static, params)))(whole)
    variables = draw_variables(network, {**whole, "beams": beams})
    logits, _ = apply(network, variables, {**whole, "beams": beams})
    assert logits.shape == (B, L * L)
    nowhere = {**whole, "beams": beams.replace(inside=beams.inside.at[:, 0].set(False))}
    changed = np.asarray(apply(network, variables, nowhere)[0] != logits)
    assert beams.inside[:, 0].any()
    np.testing.assert_array_equal(changed, beams.inside[:, 0])
    told = beams.replace(context=beams.context.at[:, -1].add(1))
    policy, value = apply(network, variables, {**whole, "beams": told})
    assert np.all(np.any(policy != logits, axis=1)), "the context is read"
    assert np.all(value != apply(network, variables, {**whole, "beams": beams})[1])
    # No search: what is left are the tracks, and looks that hold none are all alike.
    searched = beams.replace(search=jnp.zeros_like(beams.search))
    rest = np.asarray(apply(network, variables, {**whole, "beams": searched})[0])
    empty = ~np.asarray(beams.inside.any(axis=1))
    np.testing.assert_array_equal(rest[empty], 0)
    assert np.all(rest[~empty] != 0)


def test_dimensions_of_the_paper(network):
    params = network[1]["params"]
    assert params["scan_map"]["Dense_0"]["kernel"].shape == (256, 128)
    for head, outputs in (("policy", 2 * L), ("value", 1)):
        shapes = [params[head][f"Dense_{i}"]["kernel"].shape for i in range(3)]
        assert shapes == [(128 + 64, 128), (128, 128), (128, outputs)]
    hidden = {"bigru": 64, "mhsa": 32}.get(network[0].encoder)
    if hidden:
        gru = (
            params["track_list"] if network[0].encoder == "bigru" else params["track_list"]["BiGRUEncoder_0"]
        )
        assert gru["forward"]["recurrent_kernel"].shape == (hidden, 3 * hidden)
        assert gru["backward"]["recurrent_kernel"].shape == (hidden, 3 * hidden)


def test_orthogonal_gains(initialised):
    params = initialised[1]["params"]
    for layer, gain in (
        (params["scan_map"]["Dense_0"], 2**0.5),
        (params["policy"]["Dense_0"], 2**0.5),
        (params["policy"]["Dense_2"], 0.01),
        (params["value"]["Dense_2"], 1.0),
    ):
        kernel = np.asarray(layer["kernel"])
        gram = kernel.T @ kernel  # orthonormal columns, as no layer here widens
        np.testing.assert_allclose(gram, gain**2 * np.eye(len(gram)), atol=1e-5 * gain**2)
    kernel = np.asarray(params["track_list"]["BiGRUEncoder_0"]["forward"]["recurrent_kernel"])
    gates = np.split(kernel, 3, axis=-1)
    for gate in gates:
        np.testing.assert_allclose(gate.T @ gate, np.eye(len(kernel)), atol=1e-5)
    assert not np.allclose(gates[0], gates[1])


def test_learns_to_point_at_the_first_track(initialised):
    """Supervised: from the track list alone, the head must find the bin of the first live track.

    Only through attention and BiGRU, the deepest of the encoders, as each costs seconds to compile.
    """
    network, variables = initialised
    n = 32
    keys = jax.random.split(jax.random.key(4), 2)
    mask = jnp.ones((n, T), bool).at[:, 3:].set(False)
    tracks = jnp.where(mask[..., None], jax.random.uniform(keys[0], (n, T, 7), minval=-1), jnp.nan)
    batch = {"tracks": tracks, "mask": mask, "scan_map": jax.random.uniform(keys[1], (n, 48, 48))}
    target = jnp.round((tracks[:, 0, 1:3] + 1) / 2 * (L - 1)).astype(jnp.int32)
    optimiser = optax.adam(1e-3)

    def loss(variables):
        logits, _ = network.apply(variables, batch)
        return -FACTORED.log_prob(logits, target).mean()

    def update(carry, _):
        variables, state = carry
        value, gradient = jax.value_and_grad(loss)(variables)
        change, state = optimiser.update(gradient, state)
        return (optax.apply_updates(variables, change), state), value

    (_, _), losses = jax.jit(lambda c: jax.lax.scan(update, c, length=40))(
        (variables, optimiser.init(variables))
    )
    assert np.all(np.isfinite(losses))
    assert losses[-1] < losses[0] - 1.5


def test_unknown_encoder_is_refused_by_name(observation):
    with pytest.raises(ValueError, match=r"encoder = 'gru'.*flatten, bigru, mhsa"):
        PaperNetwork("gru").init(jax.random.key(0), observation)


def test_unknown_head_is_refused_by_name(observation):
    with pytest.raises(ValueError, match=r"head = 'cells'.*beams, joint, factored"):
        PaperNetwork("flatten", head="cells").init(jax.random.key(0), observation)
