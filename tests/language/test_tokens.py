import copy
import pickle

import pytest
import torch

from ldrl.language.glove import load_glove
from ldrl.language.tokens import PADDING, UNKNOWN, Tokenizer, normalise


@pytest.mark.parametrize(
    ("sentence", "words"),
    [
        ("Turn LEFT.", ["turn", "left"]),
        ("you're", ["you", "re"]),
        ("you\u2019re \u2018going\u2019", ["you", "re", "going"]),
        ("left-hand turn\u2014now", ["left", "hand", "turn", "now"]),
        ("left,right;(go)", ["left", "right", "go"]),
        ("the 2nd left", ["the", "second", "left"]),
        ("first_left", ["first", "left"]),
        ("  turn\t\nleft  ", ["turn", "left"]),
        ("\uff4c\uff45\uff46\uff54", ["left"]),
        ("na\u00efve nai\u0308ve", ["na\u00efve", "na\u00efve"]),
        ("\U0001f44d\U0001f3fd", ["\U0001f44d"]),
        ("\u2b05\ufe0f \u2192", ["\u2b05", "\u2192"]),
        ("\u5de6\u8f6c", ["\u5de6\u8f6c"]),
        ("... $ + ` !?", []),
        ("", []),
    ],
)
def test_normalise(sentence, words):
    assert normalise(sentence) == words


def test_rows_are_glove_rows_shifted_and_padded():
    glove = load_glove()
    tokens = Tokenizer(max_tokens=4)(["Turn left!", "left"])
    turn, left = glove.words["turn"] + 2, glove.words["left"] + 2
    assert tokens.tolist() == [[turn, left, PADDING, PADDING], [left, PADDING, PADDING, PADDING]]
    assert tokens.dtype == torch.int64
    assert torch.equal(glove.table[left], glove.vectors[glove.words["left"]])


def test_default_length_and_empty_batch():
    assert Tokenizer()(["left"] * 3).shape == (3, 48)
    assert Tokenizer()([]).shape == (0, 48)


def test_unknown_words_are_counted_and_become_one_id():
    tokenizer = Tokenizer(max_tokens=3)
    tokens = tokenizer(["turn zzyzzyx", "\U0001f44d", "zzyzzyx zzyzzyx"])
    assert tokens[0, 1] == UNKNOWN
    assert tokens[1].tolist() == [UNKNOWN, PADDING, PADDING]
    assert tokenizer.unknown == {"zzyzzyx": 3, "\U0001f44d": 1}


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("trun lefft", "turn left"),
        ("rihgt at the intersektion", "right at the intersection"),
        ("straigt stright straightt", "straight straight straight"),
        ("turnleft takea secnd frst", "turn left take a second first"),
        ("heft", "left"),  # a word, but a rare one
        ("lift light write strait", "lift light write strait"),  # words that are not rare
        ("lft", "lft"),  # too short to tell
        ("zzyzzyx", "zzyzzyx"),
    ],
)
def test_misspelt_and_run_together_words_are_read_as_words_of_commands(written, read):
    glove = load_glove().words
    expected = [glove[word] + 2 if word in glove else UNKNOWN for word in read.split()]
    row = Tokenizer()([written])[0]
    assert row[row != PADDING].tolist() == expected


def test_long_sentences_keep_their_first_words():
    tokenizer = Tokenizer()
    tokens = tokenizer(["left " * 5_000 + "qqqqzz"])
    assert (tokens == load_glove().words["left"] + 2).all()
    assert not tokenizer.unknown


@pytest.mark.parametrize("sentence", ["", "  \n", "?!...", "'"])
def test_an_instruction_without_words_is_refused(sentence):
    with pytest.raises(ValueError, match="has no word: say what to do, for example 'turn left'") as error:
        Tokenizer()(["turn left", sentence])
    assert repr(sentence) in str(error.value)


def test_bad_arguments():
    with pytest.raises(TypeError, match="put it in a list"):
        Tokenizer()("turn left")
    with pytest.raises(ValueError, match="max_tokens is 0"):
        Tokenizer(max_tokens=0)


def test_copies_and_pickles_stay_small():
    tokenizer = Tokenizer()
    assert len(pickle.dumps(tokenizer)) < 1000
    for other in (copy.deepcopy(tokenizer), pickle.loads(pickle.dumps(tokenizer))):
        assert other.glove is tokenizer.glove
        assert torch.equal(other(["turn left"]), tokenizer(["turn left"]))
