"""The networks that Stable-Baselines3 trains in the benchmark are ours; `make sb3` runs this."""

import jax
import numpy as np
import pytest

from benchmarks.learner import LearnerOptions
from benchmarks.ppo import configure
from benchmarks.still_world import random_observation
from jaxtrack import StaticParams
from train.networks import ENCODERS, PaperNetwork

pytestmark = [pytest.mark.sb3, pytest.mark.usefixtures("quick_compilation")]

OPTIONS = LearnerOptions(num_envs=16, rollout_steps=4, minibatch_size=32, epochs=1, seed=1)
LOOKS = StaticParams().num_looks
each_encoder = pytest.mark.parametrize("encoder", ENCODERS)


@pytest.fixture(scope="module")
def observations():
    """Track lists of 0 to 20 tracks, an empty and a full one among them."""
    keys = jax.random.split(jax.random.key(0), OPTIONS.num_envs)
    drawn = jax.vmap(lambda key: random_observation(key, StaticParams(), (0, 20)))(keys)
    arrays = {name: np.array(values) for name, values in drawn.items()}
    rng = np.random.default_rng(0)
    for row, length in enumerate((0, 20, 1)):
        arrays["mask"][row] = np.arange(20) < length
        live = arrays["mask"][row][:, None]
        arrays["tracks"][row] = live * rng.uniform(-1, 1, arrays["tracks"][row].shape)
    return arrays


def dense(params):
    """PyTorch's weight and bias of a dense layer."""
    return {"weight": params["kernel"].T, "bias": params["bias"]}


def bigru(params):
    """The state of the PyTorch BiGRU with its dense layer; its recurrent bias counts in gate n alone."""
    state = {f"dense.0.{name}": value for name, value in dense(params["Dense_0"]).items()}
    for direction, suffix in (("forward", ""), ("backward", "_reverse")):
        gru = params[direction]
        bias = np.zeros(gru["bias"].shape, np.float32)
        bias[2 * len(bias) // 3 :] = gru["recurrent_bias"]
        state[f"gru.weight_ih_l0{suffix}"] = gru["kernel"].T
        state[f"gru.bias_ih_l0{suffix}"] = gru["bias"]
        state[f"gru.weight_hh_l0{suffix}"] = gru["recurrent_kernel"].T
        state[f"gru.bias_hh_l0{suffix}"] = bias
    return state


def attention(params):
    """The state of the PyTorch attention encoder."""
    qkv, out = dense(params["SelfAttention_0"]["qkv"]), dense(params["SelfAttention_0"]["out"])
    norm = params["LayerNorm_0"]
    return {
        **{f"embed.{name}": value for name, value in dense(params["Dense_0"]).items()},
        "attention.in_proj_weight": qkv["weight"],
        "attention.in_proj_bias": qkv["bias"],
        **{f"attention.out_proj.{name}": value for name, value in out.items()},
        "norm.weight": norm["scale"],
        "norm.bias": norm["bias"],
        **{f"bigru.{name}": value for name, value in bigru(params["BiGRUEncoder_0"]).items()},
    }


def flatten(params):
    """The state of the PyTorch flatten encoder."""
    return {f"dense.1.{name}": value for name, value in dense(params["Dense_0"]).items()}


STATES = {"flatten": flatten, "bigru": bigru, "mhsa": attention}


def policy_state(params, encoder):
    """The whole policy's state: features, two MLPs and two heads."""
    cnn, state = params["scan_map"], {}
    for number, place in enumerate((0, 2, 4)):
        layer = cnn[f"Convolution_{number}"]
        state[f"convolutions.{place}.weight"] = layer["kernel"].transpose(3, 2, 0, 1)
        state[f"convolutions.{place}.bias"] = layer["bias"]
    # Ours flattens [row, column, channel], PyTorch [channel, row, column].
    kernel = cnn["Dense_0"]["kernel"].reshape(2, 2, 64, 128).transpose(2, 0, 1, 3).reshape(256, 128)
    state |= {"dense.0.weight": kernel.T, "dense.0.bias": cnn["Dense_0"]["bias"]}
    state |= {f"encoder.{name}": value for name, value in STATES[encoder](params["track_list"]).items()}
    policy = {f"features_extractor.{name}": value for name, value in state.items()}
    for name, net, head in (("policy", "policy_net", "action_net"), ("value", "value_net", "value_net")):
        for number, place in enumerate((0, 2)):
            for kind, value in dense(params[name][f"Dense_{number}"]).items():
                policy[f"mlp_extractor.{net}.{place}.{kind}"] = value
        policy |= {f"{head}.{kind}": value for kind, value in dense(params[name]["Dense_2"]).items()}
    return policy


@each_encoder
def test_with_our_weights_it_gives_our_outputs(draw_weights, observations, encoder):
    import torch

    from benchmarks.torch_learner import build_ppo, still_env

    network = PaperNetwork(encoder=encoder, num_looks=LOOKS)
    variables = draw_weights(network, observations)
    logits, value = jax.jit(network.apply)(variables, observations)

    policy = build_ppo(configure(encoder, OPTIONS), still_env(observations, LOOKS)).policy
    params = jax.tree.map(np.asarray, variables["params"])
    ours = {name: torch.tensor(np.array(array)) for name, array in policy_state(params, encoder).items()}
    policy.load_state_dict(ours, strict=False)
    given = {name for name in policy.state_dict() if not name.startswith(("pi_", "vf_"))}
    assert given == set(ours)  # no weight is without its counterpart
    inputs = {name: torch.tensor(array, dtype=torch.float32) for name, array in observations.items()}
    inputs["scan_map"] = inputs["scan_map"][:, None]
    with torch.no_grad():
        theirs = torch.stack([each.logits for each in policy.get_distribution(inputs).distribution], dim=1)
        their_value = policy.predict_values(inputs)[:, 0]
    # Categorical subtracts the logarithm of the sum.
    np.testing.assert_allclose(jax.nn.log_softmax(logits), theirs, rtol=1e-4, atol=2e-5)
    np.testing.assert_allclose(value, their_value, rtol=1e-4, atol=2e-5)
    assert np.std(value) > 0.01


@each_encoder
def test_one_update_changes_the_weights(observations, encoder):
    from benchmarks.torch_learner import build_ppo, still_env

    model = build_ppo(configure(encoder, OPTIONS), still_env(observations, LOOKS))
    before = {name: value.clone() for name, value in model.policy.named_parameters()}
    model.learn(OPTIONS.num_envs * OPTIONS.rollout_steps)
    assert model.num_timesteps == 64
    assert model._n_updates == OPTIONS.epochs
    assert all((value != before[name]).any() for name, value in model.policy.named_parameters())


@pytest.fixture
def draw_weights():
    """Random variables of a network, biases and scales too."""

    def draw(module, *inputs):
        rng = np.random.default_rng(0)

        def weights(leaf):
            scale = 0.2 if leaf.ndim == 1 else np.prod(leaf.shape[:-1]) ** -0.5
            return rng.normal(0, scale, leaf.shape).astype(leaf.dtype)

        return jax.tree.map(weights, jax.eval_shape(module.init, jax.random.key(0), *inputs))

    return draw
