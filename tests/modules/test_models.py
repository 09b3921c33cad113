"""The paper's models: which parts each has, what each reads, and that each can be saved, driven and trained."""

import dataclasses

import pytest
import torch
from torchrl.modules import set_recurrent_mode

from ldrl import keys
from ldrl.envs import make_env
from ldrl.language import Tokenizer
from ldrl.modules import (
    MODELS,
    AgentConfig,
    BranchedGRU,
    GatedAttention,
    HierarchicalAgent,
    LuongAttention,
    SingleAgent,
    SubtaskGate,
    load_agent,
    make_agent,
    save_agent,
    unroll,
)
from ldrl.objectives import ControlLoss, EndOfSubtaskLoss, SinglePolicyLoss, SubtaskLoss

HIERARCHICAL = [name for name, parts in MODELS.items() if parts.hierarchical]
SINGLE = [name for name, parts in MODELS.items() if not parts.hierarchical]


@pytest.fixture
def make(tiny):
    def make(model):
        with torch.random.fork_rng():
            torch.manual_seed(3)
            agent = make_agent(dataclasses.replace(tiny, model=model))
            for parameter in agent.parameters():
                parameter.data.mul_(2)
        return agent.eval()

    return make


@pytest.fixture
def sequences(observe):
    """Five sequences of at most four steps, and which of them count."""
    steps = torch.stack([observe(5, seed) for seed in range(4)], 1)
    generator = torch.Generator().manual_seed(0)
    steps[keys.SUBTASK] = torch.randint(0, 5, (5, 4), generator=generator)
    steps[keys.PREVIOUS_SUBTASK] = torch.randint(0, 6, (5, 4), generator=generator)
    steps[keys.ACTION] = torch.rand(5, 4, 2, generator=generator)
    steps["mask"] = torch.arange(4) < torch.tensor([[2], [4], [1], [4], [3]])
    return steps


def has(module, kind):
    return any(isinstance(part, kind) for part in module.modules())


def test_parts():
    high_level = {name: make_agent(AgentConfig(model=name)).high_level for name in HIERARCHICAL}
    assert {name for name, policy in high_level.items() if keys.IMAGE in policy.in_keys} == {"hi", "hih", "hihg", "nmc"}
    told = {name for name, policy in high_level.items() if keys.PREVIOUS_SUBTASK in policy.in_keys}
    assert told == {"hih", "hihg", "nmc"}
    assert {name for name, policy in high_level.items() if has(policy, LuongAttention)} == {"h0", "hi", "hih", "hihg"}
    assert {name for name, policy in high_level.items() if has(policy, GatedAttention)} == {"hi", "hih", "hihg"}
    assert len(high_level["h0"].module) == 3  # what a model lacks is not there
    for name in HIERARCHICAL:
        agent = make_agent(AgentConfig(model=name))
        for policy in (agent.control, agent.end_of_subtask):
            branches = [len(part.branches) for part in policy.modules() if isinstance(part, BranchedGRU)]
            assert branches == [1 if name == "hihg" else 4]
            assert has(policy, SubtaskGate) == (name == "hihg")
    told = {name for name in SINGLE if keys.PREVIOUS_ACTION in make_agent(AgentConfig(model=name)).in_keys}
    assert told == {"single-history"}


@pytest.mark.parametrize("model", MODELS)
def test_everything_that_is_read_matters(make, sequences, model):
    agent = make(model)
    policy = agent.high_level if model in HIERARCHICAL else agent.policy
    td = sequences[:, 0].clone()
    td[keys.HIGH_LEVEL_STATE] = torch.randn(5, policy.hidden, generator=torch.Generator().manual_seed(0))
    td[keys.PREVIOUS_ACTION] = sequences[:, 1][keys.ACTION]
    before = policy(td.clone())[policy.out_key]
    for key in (keys.IMAGE, keys.INSTRUCTION_TOKENS, keys.PREVIOUS_SUBTASK, keys.PREVIOUS_ACTION):
        other = td.clone()
        other[key] = td[key].roll(1, 0)
        assert torch.allclose(policy(other)[policy.out_key], before) == (key not in policy.in_keys)


@pytest.mark.parametrize("model", MODELS)
def test_a_rows_actions_are_its_own(make, drive, model):
    agent = make(model)
    together = drive(agent, 5, 6)
    alone = drive(agent, 5, 6, slice(2, 3))
    torch.testing.assert_close(alone[keys.ACTION][0], together[keys.ACTION][2])
    assert (together[keys.ACTION].abs() <= 1).all()
    assert set(agent.out_keys) <= set(together.keys(True, True))


@pytest.mark.parametrize("model", ["hih", "single"])
def test_an_agent_takes_single_steps_in_recurrent_mode_too(make, drive, model):
    agent = make(model)
    with set_recurrent_mode(True):
        there = drive(agent, 2, 3)
    torch.testing.assert_close(there[keys.ACTION], drive(agent, 2, 3)[keys.ACTION])


@pytest.mark.parametrize("model", MODELS)
def test_there_and_back(make, drive, model, tmp_path):
    agent = make(model)
    save_agent(agent, tmp_path)
    loaded = load_agent(tmp_path)
    assert type(loaded) is type(agent)
    assert loaded.config == agent.config
    assert torch.equal(drive(loaded, 3, 4)[keys.ACTION], drive(agent, 3, 4)[keys.ACTION])


def test_a_config_without_a_model_is_the_full_one():
    assert HierarchicalAgent().config.model == "hih"
    with pytest.raises(ValueError, match="model is 'h9'; use one of h0, hi, hih"):
        AgentConfig(model="h9")
    with pytest.raises(ValueError, match="model is 'single', which has no hierarchy; use make_agent"):
        HierarchicalAgent(AgentConfig(model="single"))
    with pytest.raises(ValueError, match="model is 'hih'; a SingleAgent is 'single' or 'single-history'"):
        SingleAgent(AgentConfig())
    with pytest.raises(ValueError, match="'hierarchical-gs' is a HierarchicalAgent, no SingleAgent; use load_agent"):
        SingleAgent.from_pretrained("hierarchical-gs")


@pytest.mark.parametrize("model", MODELS)
def test_unroll_is_step_by_step(make, sequences, model):
    agent = make(model)
    policy = agent.high_level if model in HIERARCHICAL else agent.policy
    sequences[keys.PREVIOUS_ACTION] = sequences[keys.ACTION].roll(1, 1)
    sequences["row"] = torch.arange(5).unsqueeze(-1).expand(5, 4)
    sequences["step"] = torch.arange(4).expand(5, 4)
    found = unroll(policy, sequences, sequences["mask"])
    assert len(found) == int(sequences["mask"].sum())
    for row in range(5):
        state = torch.zeros(1, policy.hidden)
        of_row = found[found["row"] == row]
        for step in range(int(sequences["mask"][row].sum())):
            td = sequences[row : row + 1, step].clone()
            td[keys.HIGH_LEVEL_STATE] = state
            policy(td)
            state = td["next", *keys.HIGH_LEVEL_STATE]
            got = of_row[of_row["step"] == step]
            torch.testing.assert_close(got[policy.out_key], td[policy.out_key], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("model", SINGLE)
def test_a_single_policy_starts_anew_at_a_new_instruction(make, begin, observe, model):
    agent = make(model)
    first = agent(begin(agent, 3))["next"].update(observe(3, 1))
    heard = first.clone()
    heard[keys.INSTRUCTION_TOKENS][1] = Tokenizer()(["right and then right"])[0]
    fresh = begin(agent, 3).update(observe(3, 1)).update(heard.select(keys.INSTRUCTION_TOKENS))
    out, anew, goes_on = agent(heard.clone()), agent(fresh), agent(first.clone())
    torch.testing.assert_close(out[keys.ACTION][1], anew[keys.ACTION][1])
    torch.testing.assert_close(out[keys.ACTION][[0, 2]], goes_on[keys.ACTION][[0, 2]])
    assert not torch.allclose(anew[keys.ACTION][[0, 2]], goes_on[keys.ACTION][[0, 2]])


def test_a_single_policy_remembers_what_it_did(make, town2):
    agent = make("single-history")
    rollout = make_env(town2, 2, policy=agent).rollout(4, agent)
    assert not rollout[keys.PREVIOUS_ACTION][:, 0].any()
    assert torch.equal(rollout[keys.PREVIOUS_ACTION][:, 1:], rollout[keys.ACTION][:, :-1])
    assert keys.AGENT_FINISH not in rollout.keys(True)


@pytest.mark.parametrize("model", MODELS)
def test_each_model_learns(make, sequences, model):
    agent = make(model)
    if model in HIERARCHICAL:
        sequences[keys.END_OF_SUBTASK] = sequences[keys.SUBTASK] > 2
        losses = [SubtaskLoss(agent.high_level), ControlLoss(agent.control), EndOfSubtaskLoss(agent.end_of_subtask)]
    else:
        losses = [SinglePolicyLoss(agent.policy)]
    for loss in losses:
        optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
        values = []
        for _ in range(12):
            value = loss(sequences)[loss.out_keys[0]]
            value.backward()
            optimizer.step()
            optimizer.zero_grad()
            values.append(float(value.detach()))
        assert values[-1] < values[0]
