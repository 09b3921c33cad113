"""Low-level policies: one branch per sub-task, a step at a time or a sequence at once."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import set_recurrent_mode

from ldrl import keys
from ldrl.modules import BranchedGRU, ImageEncoder, LowLevelPolicy
from ldrl.subtasks import SubTask

ALL = torch.tensor([int(subtask) for subtask in SubTask])


@pytest.fixture
def gru():
    torch.manual_seed(0)
    return BranchedGRU(4, 3)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return LowLevelPolicy("control", keys.ACTION, 2, encoder=ImageEncoder(1, (2, 3, 4), 48), features=5, hidden=3)


def test_each_subtask_has_its_own_gru(gru):
    features, state = torch.randn(5, 4), torch.randn(5, 3)
    out, after = gru(features, ALL, state)
    assert torch.equal(out, after)
    for row in range(5):
        branch = gru.branches[min(row, 3)]  # FINISH is driven as LANEFOLLOW
        cell = nn.GRUCell(4, 3)
        cell.load_state_dict({name.removesuffix("_l0"): value for name, value in branch.state_dict().items()})
        torch.testing.assert_close(out[row], cell(features[row : row + 1], state[row : row + 1])[0])


def test_sequence_is_step_after_step(gru):
    features, start = torch.randn(5, 6, 4), torch.randn(5, 3)
    state, steps = start, []
    for k in range(6):
        out, state = gru(features[:, k], ALL, state)
        steps.append(out)
    late = torch.full((5, 5, 3), 1e6)  # of the states only the first counts
    with set_recurrent_mode(True):
        sequence, states = gru(features, ALL.unsqueeze(-1).expand(5, 6), torch.cat((start.unsqueeze(1), late), 1))
    torch.testing.assert_close(sequence, torch.stack(steps, 1))
    assert torch.equal(sequence, states)


def test_gradients_reach_the_chosen_branches_only(gru):
    with set_recurrent_mode(True):
        out, _ = gru(torch.randn(2, 6, 4), torch.tensor([[0] * 6, [4] * 6]), torch.zeros(2, 6, 3))
    out.sum().backward()
    used = [any(p.grad is not None and p.grad.any() for p in branch.parameters()) for branch in gru.branches]
    assert used == [True, False, False, True]


def test_policy_keys(policy):
    state = ("agent", "control_state")
    assert policy.state_key == state
    assert set(policy.in_keys) == {keys.IMAGE, keys.AGENT_SUBTASK, state}
    assert set(policy.out_keys) == {keys.ACTION, ("next", *state)}
    other = LowLevelPolicy("end", keys.END_LOGIT, 1, encoder=ImageEncoder(1, (2, 3, 4), 48), features=5, hidden=3)
    assert not set(other.out_keys) & set(policy.out_keys)
    assert other.state_key != policy.state_key


def test_policy_sequence_is_step_after_step(policy):
    data = TensorDict(batch_size=[5, 4])
    data[keys.IMAGE] = torch.randint(0, 256, (5, 4, 1, 88, 200), dtype=torch.uint8)
    data[keys.AGENT_SUBTASK] = ALL.unsqueeze(-1).expand(5, 4).clone()
    data[policy.state_key] = torch.zeros(5, 4, 3)
    with set_recurrent_mode(True):
        sequence = policy(data.clone())
    assert sequence[keys.ACTION].shape == (5, 4, 2)
    state = torch.zeros(5, 3)
    for k in range(4):
        step = data[:, k].clone()
        step[policy.state_key] = state
        policy(step)
        state = step["next", *policy.state_key]
        torch.testing.assert_close(step[keys.ACTION], sequence[keys.ACTION][:, k])
        alone = data[2:3, k].clone()
        alone[policy.state_key] = step[policy.state_key][2:3]
        torch.testing.assert_close(policy(alone)[keys.ACTION][0], step[keys.ACTION][2])
    torch.testing.assert_close(state, sequence["next", *policy.state_key][:, -1])


def test_late_outputs_depend_on_early_images(policy):
    data = TensorDict(batch_size=[1, 6])
    data[keys.IMAGE] = torch.randint(0, 256, (1, 6, 1, 88, 200), dtype=torch.uint8)
    data[keys.AGENT_SUBTASK] = torch.zeros(1, 6, dtype=torch.long)
    data[policy.state_key] = torch.zeros(1, 6, 3)
    with set_recurrent_mode(True):
        before = policy(data.clone())[keys.ACTION]
        data[keys.IMAGE][:, 2] = 255 - data[keys.IMAGE][:, 2]
        after = policy(data.clone())[keys.ACTION]
    changed = (before != after).any(-1)[0].tolist()
    assert changed[:2] == [False, False]
    assert changed[2]
    assert changed[5]
