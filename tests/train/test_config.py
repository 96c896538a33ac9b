"""A training run's configuration: what is refused and how, and the way to JSON and back."""

import dataclasses
import json

import numpy as np
import pytest

from jaxtrack import Params, StaticParams
from train.config import TrainConfig, check, from_dict, to_dict
from train.networks import HEADS

SMALL = {"num_envs": 4, "rollout_steps": 8, "num_minibatches": 2, "microbatch": 8, "total_steps": 64}
NAN, INF = float("nan"), float("inf")


def refusal(**fields):
    """The message with which a small configuration with these fields is refused."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # callers compare the whole message
        check(TrainConfig(**{**SMALL, **fields}))
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_the_defaults_and_a_small_run_are_allowed():
    check(TrainConfig())
    check(TrainConfig(**SMALL))


@pytest.mark.parametrize(
    "name",
    [
        "total_steps",
        "num_envs",
        "rollout_steps",
        "epochs",
        "num_minibatches",
        "checkpoint_every",
    ],
)
def test_counts_are_at_least_one(name):
    for value in (0, -3):
        assert refusal(**{name: value}) == f"{name} = {value}: expected an integer >= 1"


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_have_32_bits(seed):
    assert refusal(seed=seed) == f"seed = {seed}: expected an integer in [0, 4294967295]"


@pytest.mark.parametrize(
    "name", ["warm_start_steps", "evaluation_episodes", "microbatch", "pretrain_steps", "devices"]
)
def test_counts_that_may_be_zero_are_not_negative(name):
    assert refusal(**{name: -1}) == f"{name} = -1: expected an integer >= 0"
    check(TrainConfig(**{**SMALL, name: 0}))


def test_heads_are_known_and_the_beam_policy_has_one():
    assert (
        refusal(encoder="mhsa", head="cells")
        == "head = 'cells': expected one of beams, joint, factored, gaussian"
    )
    assert refusal(head="joint") == "head = 'joint': expected beams, the head of beams"
    for head in ("beams", "joint", "factored"):
        check(TrainConfig(**{**SMALL, "encoder": "mhsa", "head": head}))


def test_a_gaussian_is_of_angles():
    assert refusal(encoder="mhsa", head="gaussian") == (
        "head = 'gaussian': expected one of beams, joint, factored without static.continuous_actions"
    )
    continuous = StaticParams(continuous_actions=True)
    for head in HEADS:
        check(TrainConfig(**{**SMALL, "encoder": "mhsa", "head": head}, static=continuous))


@pytest.mark.parametrize("name", ["gamma", "gae_lambda"])
def test_shares_lie_in_the_unit_interval(name):
    for value in (-0.1, 1.1, NAN):
        assert refusal(**{name: value}) == f"{name} = {value}: expected a number in [0, 1]"
    for value in (0.0, 1.0):
        check(TrainConfig(**{**SMALL, name: value}))


@pytest.mark.parametrize("name", ["learning_rate", "warm_start_learning_rate", "clip", "reward_scale"])
def test_scales_are_positive(name):
    for value in (0.0, -1.0, NAN, INF):
        assert refusal(**{name: value}) == f"{name} = {value}: expected a number > 0"


@pytest.mark.parametrize("name", ["entropy_coefficient", "value_coefficient", "target_kl"])
def test_coefficients_are_not_negative(name):
    for value in (-1.0, NAN, INF):
        assert refusal(**{name: value}) == f"{name} = {value}: expected a number >= 0"
    check(TrainConfig(**{**SMALL, name: 0.0}))


def test_devices_share_equally():
    for number in (3, 4):  # environments could be shared among 4, the two pieces of 8 samples not
        assert refusal(devices=number) == (
            f"devices = {number}: expected 0, or a divisor of 4 groups of environments and 2 pieces of a "
            "minibatch"
        )
    check(TrainConfig(**{**SMALL, "devices": 2}))


def test_batches_divide():
    divisor = "expected a divisor of"
    assert (
        refusal(num_minibatches=3) == f"num_minibatches = 3: {divisor} num_envs x rollout_steps = 32 samples"
    )
    # 64 minibatches of 32 samples would be empty.
    assert refusal(num_minibatches=64).startswith(f"num_minibatches = 64: {divisor}")
    assert refusal(microbatch=5) == f"microbatch = 5: {divisor} the minibatch of 16 samples"
    assert refusal(total_steps=31) == (
        "total_steps = 31: expected at least one update: >= num_envs x rollout_steps = 32"
    )


def test_sizes_follow_from_the_counts():
    config = TrainConfig(**{**SMALL, "total_steps": 95})
    assert (config.batch_size, config.minibatch_size, config.num_updates) == (32, 16, 2)


def test_encoder_is_one_that_exists():
    assert refusal(encoder="cnn") == "encoder = 'cnn': expected one of beams, flatten, bigru, mhsa"


def test_the_scenario_is_checked_too():
    assert refusal(params=Params(time_step=-1.0)).startswith("time_step = -1.0: expected a number in (0,")
    assert refusal(params=Params(clutter_rate=NAN)).startswith("clutter_rate = nan: expected")
    assert refusal(recording="states.csv").startswith(
        "recording = 'states.csv': expected the file of params."
    )
    assert refusal(params=Params(trajectories=np.zeros((2, 10, 6)))).startswith(
        "recording = '': expected the "
    )


def test_tables_are_checked_too():
    for table in ("curriculum", "randomise"):
        assert refusal(**{table: {"clutter_rate": (0, 9)}}) == (
            f"{table}.clutter_rate: clutter_rate = 9: expected at most max_clutter = 8 1/look"
        )
    for table in ("stop_above", "stop_below"):
        assert refusal(**{table: {"gospa": 9}}).startswith(f"{table}.gospa: expected one of reward, ")
        check(TrainConfig(**SMALL, **{table: {"gospa": 9}}, static=StaticParams(info_metrics=("gospa",))))
    for share in (0.0, 1.1, NAN):
        assert refusal(curriculum_share=share) == f"curriculum_share = {share}: expected a number in (0, 1]"


def test_the_folder_of_a_run_is_new(tmp_path):
    assert refusal(out=str(tmp_path)) == f"out = {str(tmp_path)!r}: expected a folder that does not exist yet"
    check(TrainConfig(**SMALL, out=str(tmp_path / "new")))
    assert not (tmp_path / "new").exists()


CHOICES = {
    "reward": "as_printed",
    "measure": "hellinger",
    "filter": "extended",
    "covariance_form": "square_root",
    "associator": "global_nearest_neighbour",
    "deleters": ("covariance", "update_time"),
    "initiator": "multi_measurement",
}


def changed(config):
    """The configuration with every number, word and choice different from the default."""
    fields = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            fields[field.name] = changed(value)
        elif isinstance(value, dict):
            is_threshold = field.name.startswith("stop_")
            fields[field.name] = {"completeness": 0.9} if is_threshold else {"clutter_rate": (0, 0.2)}
        elif field.name in CHOICES:
            fields[field.name] = CHOICES[field.name]
        elif isinstance(value, tuple):
            fields[field.name] = (*value, "gospa")
        elif isinstance(value, str):
            fields[field.name] = value + "other"
        elif value is not None:
            fields[field.name] = not value if isinstance(value, bool) else value + 1
    return dataclasses.replace(config, **fields)


def test_every_field_survives_json():
    config = changed(TrainConfig())
    values = json.loads(json.dumps(to_dict(config)))
    assert from_dict(values) == config
    assert from_dict(values) != TrainConfig()


def test_missing_fields_keep_their_defaults():
    assert from_dict({}) == TrainConfig()
    config = from_dict({"seed": 3, "static": {"num_truths": 2}, "params": {"time_step": 0.05}})
    assert config.seed == 3
    assert config.static == dataclasses.replace(TrainConfig().static, num_truths=2)
    assert config.params == dataclasses.replace(TrainConfig().params, time_step=0.05)
    # A whole number is a number.
    assert from_dict({"learning_rate": 1}).learning_rate == 1
    # What is optional can be left open in words too.
    assert from_dict({"params": {"stop_threshold": None}}).params == TrainConfig().params


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"nonsense": 1}, "nonsense: no such field; expected one of anneal, "),
        ({"static": {"nonsense": 1}}, "static.nonsense: no such field; expected one of associator, "),
        ({"params": {"nonsense": 1}}, "params.nonsense: no such field; expected one of alpha, "),
        ({"num_envs": "8"}, "num_envs = '8': expected int"),
        ({"randomise": [1, 2]}, "randomise = [1, 2]: expected dict"),
        ({"num_envs": 8.0}, "num_envs = 8.0: expected int"),
        ({"num_envs": True}, "num_envs = True: expected int"),
        ({"static": {"info_metrics": "gospa"}}, "static.info_metrics = 'gospa': expected list"),
        ({"params": {"initial_truths": 2.0}}, "params.initial_truths = 2.0: expected int"),
        ({"learning_rate": True}, "learning_rate = True: expected float"),
        ({"learning_rate": "fast"}, "learning_rate = 'fast': expected float"),
        ({"anneal": "no"}, "anneal = 'no': expected bool"),
        ({"encoder": 3}, "encoder = 3: expected str"),
        ({"static": {"num_looks": "7"}}, "static.num_looks = '7': expected int"),
        ({"params": {"time_step": None}}, "params.time_step = None: expected float"),
        ({"params": 3}, "params = 3: expected a table of fields"),
        ({"static": [1]}, "static = [1]: expected a table of fields"),
        # Wrong values of a right type are told where the record is built.
        ({"static": {"num_truths": 0}}, "num_truths = 0: expected an integer in [1, 10000]"),
    ],
)
def test_a_wrong_entry_is_named_in_one_line(values, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the message is compared below
        from_dict(values)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)
