"""From sentences to token ids."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from functools import cache, lru_cache

import torch
from rapidfuzz import process
from rapidfuzz.distance import OSA

from ldrl.language.glove import SPECIAL_ROWS, Glove, load_glove
from ldrl.language.spoken import training_words

__all__ = ["MAX_TOKENS", "PADDING", "UNKNOWN", "Tokenizer", "normalise"]

MAX_TOKENS = 48
"""Words of an instruction that are kept unless said otherwise."""
PADDING = 0
"""Token id after the end of a sentence."""
UNKNOWN = 1
"""Token id of a word that GloVe does not have and that resembles no word of the training sentences."""

RARE = 30_000
"""Words beyond this rank in GloVe are read as a word of a command that they resemble: "frst", "rihgt"."""
EDITS = {4: 1, 5: 1}
"""How many letters may differ by the word's length: none in shorter words, two in longer ones."""

LONGEST = 40
"""Letters of what can be read as a word or two: no two words of commands are longer."""

NUMERALS = {"1": "one", "2": "two", "1st": "first", "2nd": "second", "1x": "once", "2x": "twice"}
"""How often and which one in figures, and in words."""

_WORD_OR_SYMBOL = re.compile(r"[^\W_]+|[^\w\s]")


def normalise(sentence: str) -> list[str]:
    """Splits a sentence into words as speech transcripts write them.

    Lower case; small numbers in words; apostrophes, hyphens and all other punctuation separate words and are dropped.
    An emoji or another symbol outside ASCII is a word of its own, so that "⬅" is an instruction that nobody
    understands rather than none.

    Args:
        sentence: any text.

    Returns:
        The words; empty where there is nothing but space and punctuation.

    Examples:
        >>> normalise("You're going to turn-left, OK?")
        ['you', 're', 'going', 'to', 'turn', 'left', 'ok']
        >>> normalise("2nd left")
        ['second', 'left']
    """
    # NFKC first: accents join their letters and full-width letters become plain ones.
    found = _WORD_OR_SYMBOL.findall(unicodedata.normalize("NFKC", sentence).lower())
    return [NUMERALS.get(word, word) for word in found if word.isalnum() or _is_symbol(word)]


def _is_symbol(character: str) -> bool:
    # Not Sk, which modifies the character before: skin tones, free-standing accents.
    return not character.isascii() and unicodedata.category(character) in ("So", "Sm", "Sc")


@cache
def _known() -> frozenset[str]:
    return frozenset(training_words())


def _join(words: list[str]) -> list[str]:
    """Puts words of commands together that are written apart, "sec ond", unless both parts are such words, too."""
    known, joined = _known(), words[:1]
    for word in words[1:]:
        if joined[-1] + word in known and not known.issuperset((joined[-1], word)):
            joined[-1] += word
        else:
            joined.append(word)
    return joined


@lru_cache(maxsize=2**16)
def _read_as(word: str) -> tuple[str, ...]:
    """The words of commands that a misspelt or run-together word stands for; none where it resembles nothing."""
    known = _known()
    if len(word) > LONGEST:
        return ()
    for parts in ((word[:k], word[k:]) for k in range(1, len(word))):
        if all(part in known and (len(part) > 1 or part in "ai") for part in parts):
            return parts
    if len(word) < min(EDITS):
        return ()
    near = process.extractOne(word, training_words(), scorer=OSA.distance, score_cutoff=EDITS.get(len(word), 2))
    return () if near is None else (near[0],)


class Tokenizer:
    """Writes sentences as rows of token ids.

    Id 0 is padding, 1 an unknown word, and ``r + 2`` the word of row ``r`` in GloVe. A word that GloVe does not have
    or that is rare, and that differs by a letter or two from a word of the training sentences, is read as that one;
    two such words run together are taken apart, and one that is written in two parts is put together. A sentence
    longer than ``max_tokens`` keeps its first words; the longest template sentence fits. Words that remain unknown are
    counted in ``unknown``, so that a run can say what its passengers said in vain.

    Args:
        max_tokens: length of a row.
        glove: the vocabulary; None for that of the package.

    Raises:
        ValueError: ``max_tokens`` is below 1.

    Examples:
        >>> tokenizer = Tokenizer(max_tokens=4)
        >>> tokenizer(["Turn left!", "trun lefft", "turn zzyzzyx"]).tolist()
        [[892, 220, 0, 0], [892, 220, 0, 0], [892, 1, 0, 0]]
        >>> tokenizer.read("turnleft at the sec ond street")
        ['turn', 'left', 'at', 'the']
        >>> tokenizer.unknown
        Counter({'zzyzzyx': 1})
    """

    def __init__(self, max_tokens: int = MAX_TOKENS, glove: Glove | None = None) -> None:
        if max_tokens < 1:
            raise ValueError(f"max_tokens is {max_tokens}: a sentence needs at least 1")
        self.max_tokens = max_tokens
        self.glove = load_glove() if glove is None else glove
        self.unknown: Counter[str] = Counter()

    def __call__(self, sentences: Sequence[str]) -> torch.Tensor:
        """Tokenizes a batch.

        Args:
            sentences: B instructions; at least one word each.

        Returns:
            Token ids, ``[B, max_tokens]`` int64.

        Raises:
            TypeError: ``sentences`` is one string, not a sequence of them.
            ValueError: a sentence has no word.
        """
        if isinstance(sentences, str):
            raise TypeError(f"expected a sequence of sentences, got the string {sentences!r}: put it in a list")
        rows = [self._row(sentence) for sentence in sentences]
        return torch.tensor(rows, dtype=torch.int64).reshape(-1, self.max_tokens)

    def read(self, sentence: str) -> list[str]:
        """The words that a sentence is read as, whether they are known or not; at most ``max_tokens``."""
        vocabulary = self.glove.words
        said = _join(normalise(sentence))[: self.max_tokens]
        rare = [vocabulary.get(word, RARE) >= RARE for word in said]
        read = [(_read_as(word) or (word,)) if odd else (word,) for word, odd in zip(said, rare, strict=True)]
        return [word for part in read for word in part][: self.max_tokens]

    def _row(self, sentence: str) -> list[int]:
        vocabulary = self.glove.words
        words = self.read(sentence)
        if not words:
            raise ValueError(f"the instruction {sentence!r} has no word: say what to do, for example 'turn left'")
        ids = [PADDING] * self.max_tokens
        for position, word in enumerate(words):
            if word in vocabulary:
                ids[position] = vocabulary[word] + SPECIAL_ROWS
            else:
                ids[position] = UNKNOWN
                self.unknown[word] += 1
        return ids
