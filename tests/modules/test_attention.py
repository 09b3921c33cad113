"""Attention against plain loops and by hand."""

import math

import torch

from ldrl.modules import GatedAttention, LuongAttention
from ldrl.modules.attention import Concatenation, LastWord


def words(lengths, longest=5, size=3, seed=0):
    states = torch.randn(len(lengths), longest, size, generator=torch.Generator().manual_seed(seed))
    return states, torch.arange(longest) < torch.tensor(lengths).unsqueeze(-1)


def test_luong_by_hand():
    attention = LuongAttention(2, 2)
    attention.score.weight.data = torch.tensor([[0.0, 1.0], [2.0, 0.0]])
    attention.relevance.weight.data.zero_()
    states = torch.tensor([[[1.0, 0.0], [0.0, 1.0], [9.0, 9.0]]])
    is_word = torch.tensor([[True, True, False]])
    # The scores are (0, 2) . (1, 0.5) = 1 and (1, 0) . (1, 0.5) = 1: both words alike.
    torch.testing.assert_close(attention(states, is_word, torch.tensor([[1.0, 0.5]])), torch.tensor([[0.5, 0.5]]))
    # And 0 and log 3: one part of the first and three of the second.
    decoder = torch.tensor([[math.log(3), 0.0]])
    torch.testing.assert_close(attention(states, is_word, decoder), torch.tensor([[0.25, 0.75]]))
    # By themselves the words count log 9 and 0, which together with 0 and log 3 makes three parts and one.
    attention.relevance.weight.data = torch.tensor([[math.log(9), 0.0]])
    torch.testing.assert_close(attention(states, is_word, decoder), torch.tensor([[0.75, 0.25]]))


def test_luong_attends_at_the_first_decision():
    states, is_word = words([5, 2, 1])
    attention = LuongAttention(3, 4)
    found = attention(states, is_word, torch.zeros(3, 4))
    assert not torch.allclose(found[0], states[0].mean(0), atol=1e-3)


def test_luong_is_the_plain_loop():
    torch.manual_seed(0)
    attention, lengths = LuongAttention(3, 4), [5, 2, 1]
    states, is_word = words(lengths)
    decoder = torch.randn(3, 4)
    found = attention(states, is_word, decoder)
    for row, length in enumerate(lengths):
        alone = attention.relevance.weight[0]
        scores = [
            ((attention.score.weight @ states[row, k]) @ decoder[row] + alone @ states[row, k]).item()
            for k in range(length)
        ]
        total = sum(math.exp(score) for score in scores)
        mean = sum(math.exp(score) / total * states[row, k] for k, score in enumerate(scores))
        torch.testing.assert_close(found[row], mean)


def test_luong_ignores_padding():
    states, is_word = words([5, 2, 1])
    attention, decoder = LuongAttention(3, 4), torch.randn(3, 4)
    found = attention(states, is_word, decoder)
    garbage = torch.where(is_word.unsqueeze(-1), states, 1e6)
    assert torch.equal(attention(garbage, is_word, decoder), found)
    longer = torch.cat((states, torch.full((3, 4, 3), -1e6)), 1)
    more = torch.cat((is_word, torch.zeros(3, 4, dtype=torch.bool)), 1)
    torch.testing.assert_close(attention(longer, more, decoder), found)


def test_luong_without_words_is_zero():
    states, is_word = words([3, 0])
    states.requires_grad_()
    found = LuongAttention(3, 4)(states, is_word, torch.randn(2, 4))
    assert not found[1].any()
    assert found[0].any()
    found.sum().backward()
    assert states.grad.isfinite().all()


def test_luong_any_batch_shape():
    attention = LuongAttention(3, 4)
    states, is_word = words([5, 4, 3, 2, 1, 0])
    decoder = torch.randn(6, 4)
    nested = attention(states.view(2, 3, 5, 3), is_word.view(2, 3, 5), decoder.view(2, 3, 4))
    torch.testing.assert_close(nested.view(6, 3), attention(states, is_word, decoder))


def test_gate_by_hand():
    gate = GatedAttention(1, 3)
    gate.gate.weight.data = torch.tensor([[1.0], [0.0], [-100.0]])
    gate.gate.bias.data = torch.tensor([0.0, 100.0, 0.0])
    features = torch.arange(12.0).view(1, 3, 2, 2)
    found = gate(features, torch.tensor([[math.log(3)]]))
    torch.testing.assert_close(found[0, 0], features[0, 0] * 0.75)
    torch.testing.assert_close(found[0, 1], features[0, 1])
    torch.testing.assert_close(found[0, 2], torch.zeros(2, 2))


def test_gate_is_the_plain_loop():
    torch.manual_seed(0)
    gate, features, condition = GatedAttention(4, 3), torch.randn(2, 5, 3, 2, 6), torch.randn(2, 5, 4)
    found = gate(features, condition)
    for i in range(2):
        for j in range(5):
            for channel in range(3):
                score = (gate.gate.weight[channel] @ condition[i, j] + gate.gate.bias[channel]).item()
                weight = 1 / (1 + math.exp(-score))
                torch.testing.assert_close(found[i, j, channel], features[i, j, channel] * weight)


def test_last_word_is_where_each_direction_ends():
    states, is_word = words((0, 1, 3, 5), size=4)
    found = LastWord()(states, is_word)
    assert not found[0].any()
    for row, last in ((1, 0), (2, 2), (3, 4)):
        assert found[row].tolist() == [*states[row, last, :2].tolist(), *states[row, 0, 2:].tolist()]
    assert torch.equal(LastWord()(states.view(2, 2, 5, 4), is_word.view(2, 2, 5)), found.view(2, 2, 4))


def test_concatenation_is_flat():
    image, said = torch.randn(2, 3, 4, 5), torch.randn(2, 6)
    found = Concatenation()(image, said)
    assert torch.equal(found, torch.cat((image.flatten(1), said), 1))
