"""Slips of the typing finger and of the speech recogniser, mild enough for a person to read through."""

from __future__ import annotations

import random
from functools import cache
from importlib import resources
from typing import Any

import yaml

from ldrl.language.glove import load_glove

__all__ = ["slip"]

COMMON_WORDS = 40_000
"""A typo makes none of this many commonest words of GloVe, so that it reads as a typo."""
TYPO_LETTERS, SPLIT_LETTERS = 4, 6
"""Shorter words would be beyond recognition."""
_GLUE = "+"
"""Before a word: no space here."""


@cache
def _tables() -> dict[str, Any]:
    return yaml.safe_load((resources.files(__package__) / "families" / "noise.yaml").read_text("utf-8"))


def slip(sentence: str, rng: random.Random) -> str:
    """Writes a sentence as a hurried typist or a poor microphone would.

    Each slip hits another word: a typo of one letter behind the first one, a word taken for one that sounds alike,
    two words run together, one cut in two, one dropped or doubled. Sentences of up to 4 words get one slip, of up to 9
    words one or two, longer ones up to three. Directions, ordinals and words that say how often are never dropped or
    doubled. On top come careless case and punctuation. It is the blind test of noise: do not train with it.

    Args:
        sentence: words in lower case, without punctuation.
        rng: the source of randomness; nothing else decides.

    Returns:
        The sentence with its slips.

    Examples:
        >>> slip("hang a left at the corner", random.Random(0)) != "hang a left at the corner"
        True
    """
    words = sentence.split()
    untouched = list(range(len(words)))
    rng.shuffle(untouched)
    for _ in range(rng.randint(1, 1 + (len(words) > 4) + (len(words) > 9))):
        position = untouched.pop()
        slipped = None
        while slipped is None:
            slipped = _slip_word(words[position], position - 1 in untouched, rng)
        words[position] = slipped
        if slipped.startswith(_GLUE):
            untouched.remove(position - 1)
    return _scribble(" ".join(" ".join(words).replace(f" {_GLUE}", "").split()), rng)


def _slip_word(word: str, can_merge: bool, rng: random.Random) -> str | None:
    """One slip in a word, or of it and the one before; None where the draw does not fit it."""
    tables = _tables()
    kinds = ["merge"] * can_merge
    kinds += ["misheard"] * 2 * (word in tables["misheard"])
    kinds += ["typo"] * 2 * (len(word) >= TYPO_LETTERS)
    kinds += ["split"] * 2 * (len(word) >= SPLIT_LETTERS)
    kinds += ["drop"] * (word in tables["droppable"])
    kinds += ["double"] * (word not in tables["crucial"])
    kind = rng.choice(kinds)
    if kind == "misheard":
        return rng.choice(tables["misheard"][word])
    if kind == "typo":
        return _typo(word, rng)
    if kind == "split":
        cut = rng.randint(2, len(word) - 2)
        return f"{word[:cut]} {word[cut:]}"
    return {"merge": _GLUE + word, "drop": "", "double": f"{word} {word}"}[kind]


def _typo(word: str, rng: random.Random) -> str | None:
    """Swaps, drops, doubles or replaces one letter, never the first."""
    k = rng.randrange(1, len(word))
    row = next(row for row in _tables()["keyboard"] if word[k] in row)
    at = row.index(word[k])
    neighbour = rng.choice(row[max(at - 1, 0) : at] + row[at + 1 : at + 2])
    typo = rng.choice(
        [
            word[:k] + word[k + 1 : k + 2] + word[k] + word[k + 2 :],
            word[:k] + word[k + 1 :],
            word[:k] + word[k] + word[k:],
            word[:k] + neighbour + word[k + 1 :],
        ]
    )
    return None if load_glove().words.get(typo, COMMON_WORDS) < COMMON_WORDS else typo


def _scribble(sentence: str, rng: random.Random) -> str:
    """Adds careless case and punctuation, which say nothing."""
    words = sentence.split()
    if rng.random() < 0.5:
        words[rng.randrange(len(words))] += rng.choice(_tables()["marks"])
    case = rng.choice((str, str, str.capitalize, str.upper, str.title))
    return case(" ".join(words))
