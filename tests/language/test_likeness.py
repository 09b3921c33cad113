"""What words look and sound like."""

import pickle

import pytest
import torch

from ldrl.language import MEANINGFUL, PADDING, UNKNOWN, Likeness, Tokenizer

WORDS = sorted(MEANINGFUL)


def alike(word, other):
    """How much a word looks and sounds like one of the meaningful words."""
    looks, sounds = Likeness()(Tokenizer(1)([word])[0, 0]).view(2, len(WORDS))[:, WORDS.index(other)].tolist()
    return looks, sounds


@pytest.mark.parametrize(
    ("word", "other", "looks", "sounds"),
    [
        ("left", "left", 1, 1),
        ("strait", "straight", 6 / 8, 1),  # two letters of eight; both are STRT
        ("loft", "left", 3 / 4, 1),
        ("strayed", "straight", 4 / 8, 4 / 5),  # STRYT
        ("banana", "left", 0, 0),
    ],
)
def test_by_hand(word, other, looks, sounds):
    assert alike(word, other) == pytest.approx((looks, sounds))


def test_every_meaningful_word_is_most_like_itself():
    table = Likeness()(Tokenizer(1)(WORDS)).view(len(WORDS), 2, len(WORDS))
    assert (table.diagonal(dim1=0, dim2=2) == 1).all()
    assert (table[:, 0] == 1).sum() == len(WORDS)
    assert ((table >= 0) & (table <= 1)).all()


def test_nothing_is_like_no_word():
    likeness = Likeness()
    assert likeness.out_features == 2 * len(WORDS)
    assert not likeness(torch.tensor([[PADDING, UNKNOWN]])).any()


def test_it_is_unsaved_and_follows_its_input_to_a_device():
    likeness = Likeness()
    assert not likeness.state_dict()
    assert len(pickle.dumps(likeness)) < 2000
    assert likeness(torch.ones(2, 3, dtype=torch.int64, device="meta")).shape == (2, 3, likeness.out_features)


def test_it_compiles_whole():
    tokens, likeness = torch.tensor([[2, 0]]), Likeness()
    compiled = torch.compile(likeness, fullgraph=True, backend="eager")
    assert torch.equal(compiled(tokens), likeness(tokens))
