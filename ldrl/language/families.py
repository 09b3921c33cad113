"""Four families of sentences that try a listener: never to be trained on, nor looked at to train better."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import resources
from itertools import product
from typing import Literal, get_args

import yaml

from ldrl.language.keywords import KEYWORDS, Keyword
from ldrl.language.sentences import Sentences
from ldrl.language.slips import slip

__all__ = ["Families", "Family"]

Family = Literal["paraphrase", "ambiguity", "noise", "rambling"]
"""Other words, few words, garbled words, too many words."""

_OPPOSITE = {"left": "right", "right": "left", "straight": "left", "first": "second", "second": "first"}


class Families:
    """The sentences of one family, for every keyword.

    Paraphrases and ambiguities are products of the parts in ``families/*.yaml``. Noise is a held-out sentence with
    slips (:func:`~ldrl.language.slips.slip`), rambling mostly one among small talk and corrections, so that these two
    measure little but the disturbance.

    Args:
        family: which one.

    Raises:
        ValueError: there is no such family.

    Examples:
        >>> sentence = Families("ambiguity").sample("second left", random.Random(0))
        >>> "left" in sentence
        True
    """

    def __init__(self, family: Family) -> None:
        if family not in get_args(Family):
            raise ValueError(f"unknown family {family!r}: use one of {', '.join(get_args(Family))}")
        self.family = family
        self._clean = Sentences("heldout")

    def sample(self, keyword: str | Keyword, rng: random.Random, clean: str | None = None) -> str:
        """Draws a pattern of the keyword, then each of its parts, all uniformly.

        Args:
            keyword: any spelling that :meth:`Keyword.parse` knows.
            rng: the source of randomness; nothing else decides.
            clean: the sentence that is disturbed, in noise and rambling; None draws a held-out one.

        Returns:
            The sentence, with case and punctuation.

        Raises:
            ValueError: there is no such keyword.
        """
        keyword = Keyword.parse(keyword)
        clean = self._clean.sample(keyword, rng) if clean is None else clean
        if self.family == "noise":
            return slip(clean, rng)
        slots = rng.choice(_patterns(self.family, keyword.name))
        return _join(clean if parts is None else rng.choice(parts) for parts in slots)

    def all(self, keyword: str | Keyword) -> Iterator[str]:
        """Iterates over the keyword's sentences, some of them more than once.

        Raises:
            ValueError: the family is noise, whose sentences are no products of parts.
        """
        if self.family == "noise":
            raise ValueError("the sentences of noise cannot be listed; draw them with sample")
        keyword = Keyword.parse(keyword)
        for slots in _patterns(self.family, keyword.name):
            yield from map(_join, product(*(self._clean.all(keyword) if parts is None else parts for parts in slots)))


def _join(parts: Iterable[str]) -> str:
    return " ".join(filter(None, parts)).replace(" ,", ",").strip(" ,")


@cache
def _patterns(family: Family, name: str) -> list[list[list[str] | None]]:
    """Of each pattern of a keyword the parts of its slots; None stands for a clean sentence."""
    text = (resources.files(__package__) / "families" / f"{family}.yaml").read_text("utf-8")
    file = yaml.safe_load(text)
    keyword = KEYWORDS[name]
    words = {"dir": keyword.manoeuvres[0].name.lower(), "then": keyword.manoeuvres[-1].name.lower()}
    if keyword.type == "ordinal":
        words["nth"] = name.split(maxsplit=1)[0]
    opposites = {"other": words["dir"], "other_then": words["then"], "other_nth": words.get("nth", "first")}
    words |= {key: _OPPOSITE[word] for key, word in opposites.items()}
    return [
        [
            None if slot == "command" else [part.format(**words) for part in file["slots"][slot]]
            for slot in group["sentence"]
        ]
        for group in file["groups"]
        if name in group["keywords"]
    ]
