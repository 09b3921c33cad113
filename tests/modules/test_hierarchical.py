"""The agent as a whole: who decides when, and that its memory is in the TensorDict and nowhere else."""

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs.utils import step_mdp

from ldrl import keys
from ldrl.envs import make_env
from ldrl.language import Tokenizer
from ldrl.modules import AgentConfig, HierarchicalAgent
from ldrl.modules.hierarchical import VOTES
from ldrl.subtasks import SubTask

LEFT, RIGHT, STRAIGHT, FOLLOW, FINISH = SubTask
DONE = (keys.ACTION, keys.AGENT_SUBTASK, keys.AGENT_FINISH, keys.SWITCH)


class VoteOfPixel(TensorDictModuleBase):
    """An end-of-sub-task policy of one's own: votes as the image's first pixel says."""

    in_keys = [keys.IMAGE]  # noqa: RUF012
    hidden = 1

    def __init__(self, state_key):
        super().__init__()
        self.state_key = state_key
        self.out_keys = [keys.END_LOGIT, ("next", *state_key)]

    def forward(self, tensordict):
        tensordict[keys.END_LOGIT] = tensordict[keys.IMAGE][..., 0, 0].float() - 0.5
        tensordict["next", *self.state_key] = torch.zeros(*tensordict.shape, 1)
        return tensordict


class ChoiceOfPixel(TensorDictModuleBase):
    """A high-level policy of one's own: chooses the sub-task that the image's second pixel says."""

    in_keys = [keys.IMAGE, keys.PREVIOUS_SUBTASK]  # noqa: RUF012
    out_keys = [keys.SUBTASK_LOGITS, ("next", *keys.HIGH_LEVEL_STATE)]  # noqa: RUF012
    hidden = 1

    def __init__(self):
        super().__init__()
        self.previous = []

    def forward(self, tensordict):
        self.previous += tensordict[keys.PREVIOUS_SUBTASK].tolist()
        choice = tensordict[keys.IMAGE][..., 0, 0, 1].long()
        tensordict[keys.SUBTASK_LOGITS] = nn.functional.one_hot(choice, len(SubTask)).float()
        tensordict["next", *keys.HIGH_LEVEL_STATE] = torch.zeros(*tensordict.shape, 1)
        return tensordict


@pytest.fixture
def scripted(agent):
    """An agent whose votes and choices are read off the image."""
    agent.high_level = ChoiceOfPixel()
    agent.end_of_subtask = VoteOfPixel(agent.end_of_subtask.state_key)
    return agent


@pytest.fixture
def restless(agent):
    """An agent that votes for an end now and then, so that it switches often."""
    agent.end_of_subtask.module[-1].bias.data += 0.7
    return agent


def play(agent, td, script):
    """Drive one car by a script of (vote, choice, sentence); returns the sub-tasks and where it switched."""
    subtasks, switches = [], []
    for vote, choice, sentence in script:
        td[keys.IMAGE] = torch.zeros(1, 1, 88, 200, dtype=torch.uint8)
        td[keys.IMAGE][..., 0, :2] = torch.tensor([vote, choice], dtype=torch.uint8)
        td[keys.INSTRUCTION_TOKENS] = Tokenizer()([sentence])
        td = agent(td)
        subtasks.append(SubTask(td[keys.AGENT_SUBTASK].item()))
        switches.append(td[keys.SWITCH].item())
        td = td["next"]
    return subtasks, [k for k, switched in enumerate(switches) if switched]


def test_a_whole_drive_by_hand(scripted, begin):
    say, then = "turn left", "go right"
    script = [
        (1, FOLLOW, say),  # 0: decides at once; this vote is its first
        (1, LEFT, say),
        (0, LEFT, say),
        (0, LEFT, say),  # 3: two votes of three
        (1, RIGHT, say),  # 4: the votes before the switch are gone: 0, 1
        (1, RIGHT, say),
        (0, RIGHT, say),  # 6: 0, 1, 1 have been cast
        (0, STRAIGHT, say),
        (0, STRAIGHT, then),  # 8: a new instruction in a manoeuvre waits
        (1, STRAIGHT, then),
        (0, STRAIGHT, then),
        (1, STRAIGHT, then),
        (0, FOLLOW, then),  # 12: 1, 0, 1; the new plan begins
        (0, FINISH, then),
        (0, FINISH, say),  # 14: a new instruction while following a lane, at once
        (1, LEFT, say),
        (1, LEFT, say),
        (1, LEFT, say),
        (1, LEFT, say),  # 18: votes do not end FINISH
        (1, RIGHT, then),  # 19: a new instruction does
        (0, FOLLOW, then),
    ]
    subtasks, switches = play(scripted, begin(scripted, 1), script)
    assert switches == [0, 3, 6, 12, 14, 19]
    parts = [(FOLLOW, 3), (LEFT, 3), (RIGHT, 6), (FOLLOW, 2), (FINISH, 5), (RIGHT, 2)]
    assert subtasks == [subtask for subtask, steps in parts for _ in range(steps)]
    assert scripted.high_level.previous == [5, FOLLOW, LEFT, 5, 5, 5]


def test_votes_are_cleared_at_each_switch(scripted, begin):
    script = [(1, k % 3, "turn left") for k in range(10)]
    assert play(scripted, begin(scripted, 1), script)[1] == [0, 3, 6, 9]


def test_recurrent_states_start_anew_at_a_switch(restless, drive):
    done = drive(restless, 5, 24)
    switched = done[keys.SWITCH]
    assert switched[:, 1:].any()
    assert not switched.all()
    assert not done["next", *keys.VOTES][switched][:, :-1].any()
    assert done["next", *keys.VOTES][switched][:, -1].any()
    for row in range(5):
        for step in switched[row].nonzero().flatten().tolist():
            fresh = done[row : row + 1, step].exclude("next")
            for policy in (restless.control, restless.end_of_subtask):
                fresh[policy.state_key] = torch.zeros(1, policy.hidden)
            expected = restless.control(fresh)[keys.ACTION][0]
            expected = torch.stack((expected[0].clamp(0, 1), expected[1].clamp(-1, 1)))
            if done[row, step][keys.AGENT_SUBTASK] == FINISH:
                expected[0] = 0
            torch.testing.assert_close(done[row, step][keys.ACTION], expected)


def test_only_rows_that_switch_pay(agent, begin, observe):
    asked = []
    agent.high_level.register_forward_pre_hook(lambda _, inputs: asked.append(inputs[0].batch_size[0]))
    td = begin(agent, 5)
    agent(td)
    assert asked == [5]
    td = td["next"].update(observe(5, 1))
    agent(td)
    assert asked == [5]
    td = td["next"].update(observe(5, 2))
    td[keys.AGENT_SUBTASK] = torch.tensor([FOLLOW, FOLLOW, LEFT, LEFT, LEFT])
    td[keys.AGE] = torch.tensor([5, 0, 5, 5, 2])
    td[keys.VOTES] = torch.tensor([[0, 0, 1], [0, 0, 0], [1, 0, 1], [0, 0, 0], [0, 1, 1]]).bool()
    out = agent(td.clone())
    assert asked == [5, 2]
    assert out[keys.SWITCH].tolist() == [False, True, True, False, False]
    assert out[keys.AGENT_SUBTASK][[0, 3, 4]].tolist() == [FOLLOW, LEFT, LEFT]
    kept = torch.tensor([0, 3, 4])
    assert torch.equal(out["next", *keys.HIGH_LEVEL_STATE][kept], td[keys.HIGH_LEVEL_STATE][kept])
    assert not torch.equal(out["next", *keys.HIGH_LEVEL_STATE][2], td[keys.HIGH_LEVEL_STATE][2])


def test_a_batch_row_is_a_run_of_one(restless, drive):
    together = drive(restless, 5, 20)
    assert together[keys.SWITCH][:, 1:].any(1).sum() > 1
    for row in range(5):
        alone = drive(restless, 5, 20, slice(row, row + 1))
        for key in (*DONE, *(("next", *key) for key in restless._memory)):
            torch.testing.assert_close(alone[key][0], together[key][row])


def test_a_single_car_needs_no_batch(agent, begin):
    td = begin(agent, 3)
    together = agent(td.clone())
    alone = agent(td[1].clone())
    assert alone.batch_size == ()
    torch.testing.assert_close(alone[keys.ACTION], together[keys.ACTION][1])
    assert alone["next", *keys.AGE] == 1


def test_cars_may_lie_in_any_batch(agent, begin):
    td = begin(agent, 6)
    flat, nested = agent(td.clone()), agent(td.clone().reshape(2, 3))
    for key in agent.out_keys:
        torch.testing.assert_close(nested[key].flatten(0, 1), flat[key])


def test_everything_it_writes_is_said(agent, begin):
    td = begin(agent, 2)
    before = set(td.keys(True, True))
    assert set(agent.in_keys) == before
    inputs = td.clone()
    written = set(agent(td).keys(True, True)) - before
    assert written <= set(agent.out_keys)
    assert set(agent.out_keys) <= set(td.keys(True, True))
    for key in before - set(agent.out_keys):
        assert torch.equal(td[key], inputs[key]), key


def test_actions_lie_in_bounds(agent, drive):
    agent.control.module[-1].weight.data.mul_(50)
    action = drive(agent, 5, 10)[keys.ACTION]
    assert action.isfinite().all()
    assert (action[..., 0] >= 0).all()
    assert (action.abs() <= 1).all()
    assert action[..., 1].abs().max() == 1


def test_a_rollout_may_be_cut_and_resumed(restless, town2, episodes):
    def env():
        return make_env(town2, episodes=episodes["town2"][:3], policy=restless)

    whole = env().rollout(16, restless)
    assert whole[keys.SWITCH][:, 1:].any()
    resumed = env()
    first = resumed.rollout(7, restless)
    after = step_mdp(first[:, -1])
    second = resumed.rollout(9, restless, tensordict=after, auto_reset=False)
    for key in (*DONE, keys.POSE, *restless._memory):
        torch.testing.assert_close(torch.cat((first[key], second[key]), 1), whole[key])


def test_one_cars_reset_disturbs_nobody(restless, town2, episodes):
    some, row = episodes["town2"][:3], 1

    def steps(env, td, count):
        done = []
        for _ in range(count):
            td = env.step(restless(td))
            done.append(td)
            td = step_mdp(td)
        return torch.stack(done, 1), td

    env = make_env(town2, episodes=some, policy=restless)
    undisturbed, _ = steps(env, env.reset(), 14)
    env = make_env(town2, episodes=some, policy=restless)
    _, td = steps(env, env.reset(), 6)
    td["_reset"] = torch.arange(3).unsqueeze(-1) == row
    td = env.reset(td)
    for key in restless._memory:
        assert not td[key][row].any()
    assert td[keys.AGE][0] == undisturbed[keys.AGE][0, 6]
    after, _ = steps(env, td, 8)
    for key in DONE:
        for other in (0, 2):
            torch.testing.assert_close(after[key][other], undisturbed[key][other, 6:])
        # The car that was reset drives as at its first time: nothing of that reached its second episode.
        torch.testing.assert_close(after[key][row], undisturbed[key][row, :8])


@pytest.mark.parametrize("steps", [5, 8])
def test_runs_under_a_collector(restless, town2, steps):
    env = make_env(town2, 2, policy=restless, max_steps=steps)
    collector = Collector(env, restless, frames_per_batch=24, total_frames=48)
    batches = list(collector)
    collector.shutdown()
    drives = torch.cat(batches, -1)
    assert drives.shape == (2, 24)
    starts = torch.arange(24) % steps == 0
    assert torch.equal(drives["next", "truncated"].squeeze(-1), (torch.arange(24) % steps == steps - 1).expand(2, 24))
    for key in restless._memory:
        if key != keys.AGENT_SUBTASK:  # the one that the agent also writes at the root
            assert not drives[key][:, starts].any(), key
    assert drives[keys.SWITCH][:, starts].all()
    assert drives[restless.control.state_key][:, ~starts].any()


def test_memory_is_declared_for_every_env(agent, town2):
    env = make_env(town2, 2, policy=agent)
    assert set(agent._memory) <= set(env.observation_spec.keys(True, True))
    assert env.reset()[keys.VOTES].shape == (2, VOTES)


def test_without_its_memory_it_says_what_to_do(agent, observe, town2):
    with pytest.raises(KeyError, match=r"is missing; give the env .* agent\.make_tensordict_primer\(\)"):
        agent(observe(2, 0))
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        make_env(town2, 2).rollout(2, agent)


def test_after_finish_the_car_rolls_to_a_stop(agent, town2, episodes):
    agent.high_level.module[-1].module.head.bias.data[FINISH] = 100.0
    agent.control.module[-1].bias.data[0] = 100.0
    agent.end_of_subtask.module[-1].bias.data[:] = 100.0
    rollout = make_env(town2, episodes=episodes["town2"][:2], policy=agent).rollout(100, agent)
    assert rollout[keys.AGENT_FINISH].all()
    assert (rollout[keys.AGENT_SUBTASK] == FINISH).all()
    assert not rollout[keys.SWITCH][:, 1:].any()
    assert not rollout[keys.ACTION][..., 0].any()
    assert rollout[keys.SPEED][:, 0].min() > 4
    assert rollout["next", *keys.SPEED][:, -1].max() < 0.1
    assert rollout["next", *keys.PROGRESS][:, -1].max() < 12
    assert rollout["next", "terminated"][:, -1].all()
    agent.high_level.module[-1].module.head.bias.data[FINISH] = -100.0
    rollout = make_env(town2, episodes=episodes["town2"][:2], policy=agent).rollout(5, agent)
    assert not rollout[keys.AGENT_FINISH].any()
    assert (rollout[keys.ACTION][..., 0] == 1).all()


def test_parts_may_be_swapped(agent, town2):
    class Steady(TensorDictModuleBase):
        in_keys = [keys.AGENT_SUBTASK]  # noqa: RUF012
        out_keys = [keys.ACTION]  # noqa: RUF012
        hidden, state_key = 2, agent.control.state_key

        def forward(self, tensordict):
            tensordict[keys.ACTION] = torch.tensor([0.5, -0.25]).expand(*tensordict.shape, 2)
            tensordict["next", *self.state_key] = tensordict[self.state_key] + 1
            return tensordict

    agent.control = Steady()
    gate = agent.high_level.module[3]
    calls = []

    def ungated(image, said):
        calls.append(len(image))
        return image

    agent.high_level.module[3] = TensorDictModule(ungated, gate.in_keys, gate.out_keys)
    agent.high_level.module[-1].module.head.bias.data[FINISH] = -100.0
    rollout = make_env(town2, 2, policy=agent).rollout(3, agent)
    torch.testing.assert_close(rollout[keys.ACTION], torch.tensor([0.5, -0.25]).expand(2, 3, 2))
    assert rollout[Steady.state_key].tolist() == [[[0, 0], [1, 1], [2, 2]]] * 2
    assert calls == [2]


def test_sizes_come_from_the_config():
    small, paper = AgentConfig(), AgentConfig.paper()
    assert paper.conv_channels == (256, 64, 64)
    assert (paper.high_level_hidden, paper.instruction_hidden, paper.subtask_embedding) == (256, 32, 64)
    agent = HierarchicalAgent(paper)
    assert agent.control.module[2].module.branches[0].hidden_size == 256
    assert agent.control.module[0].module.out_features == 64 * 3 * 10
    assert agent.high_level.module[-1].module.gru.input_size == paper.features + 64
    count = [sum(p.numel() for p in HierarchicalAgent(config).parameters()) for config in (small, paper)]
    assert count[0] * 2 < 4 * 2**20  # bytes of the checkpoint that ships, in half precision
    assert count[0] < count[1]
