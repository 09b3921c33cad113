"""Disturbed sentences: what a listener must see through."""

from __future__ import annotations

import random
from collections.abc import Sequence

from ldrl.language.tokens import normalise

__all__ = ["MEANINGFUL", "disturb"]

MEANINGFUL = frozenset(
    (
        "left",
        "right",
        "straight",
        "first",
        "second",
        "next",
        "two",
        "twice",
        "times",
        "both",
        "another",
        "again",
        "more",
    )
)
"""Words that say which way and how often; they are never touched."""


def disturb(sentence: str, vocabulary: Sequence[str], rng: random.Random, rate: float = 0.1) -> str:
    """Drop, replace and insert words that do not say which way or how often.

    Args:
        sentence: any sentence.
        vocabulary: where new words come from.
        rng: the source of randomness.
        rate: probability of each of the three, per word.

    Returns:
        A sentence of at least one word that means the same to who listens for the words that matter.

    Examples:
        >>> disturb("please take a left here", ["wonderful"], random.Random(3), rate=0.2)
        'please take wonderful left wonderful'
    """
    words = []
    for word in normalise(sentence):
        if rng.random() < rate:
            words.append(rng.choice(vocabulary))
        chance = rng.random()
        if word in MEANINGFUL or chance >= 2 * rate:
            words.append(word)
        elif chance < rate:
            words.append(rng.choice(vocabulary))
    return " ".join(words) or sentence
