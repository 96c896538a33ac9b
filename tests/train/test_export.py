"""Exported agents: the weights come back, damage and strangers are refused; those shipped load and play."""

import json
from pathlib import Path

import jax
import pytest

from jaxtrack.policies import POLICIES
from tests.train.small_run import CONFIG, STATIC, assert_same, at, random_state, write_run
from train.agents import agent_policy
from train.episodes import Competitor, compare, rule
from train.export import main
from train.saved_run import AGENT, load_run

SHIPPED = sorted(path.parent for path in Path(__file__).parents[2].glob(f"agents/*/{AGENT}"))


@pytest.fixture
def exported(tmp_path):
    """A run of random weights, and the agent that was exported from it."""
    state = random_state()
    (tmp_path / "run").mkdir()
    write_run(tmp_path / "run", state)
    out = tmp_path / "agents" / "mine"
    assert main(["--run", str(tmp_path / "run"), "--out", str(out)]) == 0
    return state, out


def test_an_agent_is_the_configuration_and_the_weights_of_a_run(exported):
    state, out = exported
    assert sorted(path.name for path in out.iterdir()) == ["agent.json", "agent.npz", "config.json"]
    config, env, weights = load_run(out)
    assert config == CONFIG
    assert env.static == STATIC
    assert_same(weights, at(state, 1).weights)


def test_an_agent_is_not_overwritten(exported):
    _, out = exported
    before = (out / AGENT).read_bytes()
    with pytest.raises(ValueError, match=r"expected a folder without agent\.npz"):
        main(["--run", str(out.parents[1] / "run"), "--out", str(out)])
    assert (out / AGENT).read_bytes() == before


@pytest.mark.parametrize("given", [["--run", "a"], ["--out", "a"]])
def test_both_folders_must_be_given(given):
    with pytest.raises(ValueError, match=r"^(run|out): expected a folder, --(run|out) FOLDER$"):
        main(given)


@pytest.mark.parametrize("place", [0.1, 0.5, 0.9])
def test_a_damaged_agent_is_refused(exported, place):
    path = exported[1] / AGENT
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 4
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"agent\.npz: is damaged .*SHA-256 is another"):
        load_run(exported[1])


def test_another_configuration_is_refused(exported):
    path = exported[1] / "config.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "gamma": 0.5}))
    with pytest.raises(
        ValueError, match=r"config\.json: gamma = 0\.5, but the checkpoint was trained with 0\.99"
    ):
        load_run(exported[1])


def test_agents_are_shipped():
    assert SHIPPED


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_shipped_agents_load_and_are_small(folder):
    config, _, weights = load_run(folder)
    assert config.encoder == folder.name
    assert jax.tree.leaves(weights)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000


@pytest.mark.slow
@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_shipped_agents_are_better_than_the_tuned_index_rule(folder):
    config, env, weights = load_run(folder)
    played = compare(
        {
            "agent": Competitor(
                lambda own: agent_policy(config.encoder, own, head=config.head), [weights], (config.seed,)
            ),
            "rule": rule(POLICIES["index_tuned"]),
        },
        env,
        config.params,
        episodes=50,
        seed=1_000_000,
    ).played
    difference = played["agent"].values["gospa"] - played["rule"].values["gospa"]
    assert difference.mean() < -2 * difference.std() / 50**0.5
