"""The high-level policy."""

import pytest
import torch

from ldrl import keys
from ldrl.modules import NO_SUBTASK
from ldrl.subtasks import SubTask

STATE = keys.HIGH_LEVEL_STATE


@pytest.fixture
def asked(agent, observe):
    td = observe(6, 0)
    td[keys.PREVIOUS_SUBTASK] = torch.tensor([NO_SUBTASK, 3, 0, 1, 2, 4])
    td[STATE] = torch.randn(6, agent.high_level.hidden, generator=torch.Generator().manual_seed(0))
    return td


def test_keys_and_shapes(agent, asked):
    assert set(agent.high_level.in_keys) == {keys.IMAGE, keys.INSTRUCTION_TOKENS, keys.PREVIOUS_SUBTASK, STATE}
    assert set(agent.high_level.out_keys) == {keys.SUBTASK_LOGITS, ("next", *STATE)}
    before = set(asked.keys(True, True))
    out = agent.high_level(asked)
    assert set(out.keys(True, True)) - before == set(agent.high_level.out_keys)
    assert out[keys.SUBTASK_LOGITS].shape == (6, len(SubTask))
    assert out["next", *STATE].shape == (6, agent.high_level.hidden)


def test_a_row_alone(agent, asked):
    together = agent.high_level(asked.clone())
    for row in range(6):
        alone = agent.high_level(asked[row : row + 1].clone())
        for key in agent.high_level.out_keys:
            torch.testing.assert_close(alone[key][0], together[key][row])


@pytest.mark.parametrize("key", [keys.IMAGE, keys.INSTRUCTION_TOKENS, keys.PREVIOUS_SUBTASK, STATE])
def test_every_input_matters(agent, asked, key):
    before = agent.high_level(asked.clone())
    asked[key] = asked[key].roll(1, 0)
    after = agent.high_level(asked)
    for out in agent.high_level.out_keys:
        assert not torch.allclose(after[out], before[out])


def test_padding_does_not_matter(agent, asked):
    before = agent.high_level(asked.clone())[keys.SUBTASK_LOGITS]
    shorter = asked.clone()
    shorter[keys.INSTRUCTION_TOKENS] = asked[keys.INSTRUCTION_TOKENS][:, :9]
    torch.testing.assert_close(agent.high_level(shorter)[keys.SUBTASK_LOGITS], before)


def test_an_instruction_of_unknown_words_or_none_is_no_nan(agent, asked):
    asked[keys.INSTRUCTION_TOKENS] = torch.zeros_like(asked[keys.INSTRUCTION_TOKENS])
    asked[keys.INSTRUCTION_TOKENS][0] = 1
    assert agent.high_level(asked)[keys.SUBTASK_LOGITS].isfinite().all()
