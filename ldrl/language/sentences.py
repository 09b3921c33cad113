"""Sentences that say a keyword, put together from the parts listed in ``templates/*.yaml``."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from functools import cache
from importlib import resources
from itertools import product
from typing import Literal, get_args

import yaml

from ldrl.language.keywords import KEYWORDS, Keyword

__all__ = ["Sentences", "Split"]

Split = Literal["train", "heldout"]
"""Which sentences: those to train on, or those kept for evaluation, made of other parts."""

_Group = tuple[tuple[str, ...], ...]
"""The parts that can stand in each place of a sentence; a sentence takes one per place."""


class Sentences:
    """The sentences of one split.

    A keyword's sentences come in groups, each the product of its slots. No sentence belongs to two keywords, and
    no held-out sentence shares a body or connective with training sentences.

    Args:
        split: ``"train"`` or ``"heldout"``.

    Raises:
        ValueError: there is no such split.

    Examples:
        >>> sentences = Sentences("train")
        >>> sentences.count("left")
        128
        >>> next(sentences.all("(second, left)"))
        'take the second left'
        >>> sentences.sample("left,right", random.Random(0))
        'um left and then right please'
    """

    def __init__(self, split: Split) -> None:
        if split not in get_args(Split):
            raise ValueError(f"unknown split {split!r}: use one of {', '.join(get_args(Split))}")
        self.split = split
        self._groups = {name: _groups(name, split) for name in KEYWORDS}

    def sample(self, keyword: str | Keyword, rng: random.Random) -> str:
        """Draws a group of the keyword, then a sentence of the group, both uniformly.

        Args:
            keyword: any spelling that :meth:`Keyword.parse` knows.
            rng: the source of randomness; nothing else decides.

        Returns:
            The sentence: lower case, no punctuation.

        Raises:
            ValueError: there is no such keyword.
        """
        group = rng.choice(self._groups[Keyword.parse(keyword).name])
        return _join(rng.choice(parts) for parts in group)

    def parts(self, keyword: str | Keyword) -> Iterator[str]:
        """Iterates over the parts that the keyword's sentences are made of, some of them more than once."""
        for group in self._groups[Keyword.parse(keyword).name]:
            for slot in group:
                yield from slot

    def count(self, keyword: str | Keyword) -> int:
        """Returns how many distinct sentences the keyword has."""
        return sum(math.prod(map(len, group)) for group in self._groups[Keyword.parse(keyword).name])

    def all(self, keyword: str | Keyword) -> Iterator[str]:
        """Iterates over the keyword's sentences, each once."""
        for group in self._groups[Keyword.parse(keyword).name]:
            yield from map(_join, product(*group))


def _join(parts: Iterator[str] | tuple[str, ...]) -> str:
    return " ".join(filter(None, parts))


_FILES = ("common", "single", "double", "ordinal")


@cache
def _templates() -> list[tuple[tuple[str, ...], list[dict[str, list[str]]]]]:
    """Reads each group: its keywords, and for each of its slots the parts by split."""
    folder = resources.files(__package__) / "templates"
    files = {kind: yaml.safe_load((folder / f"{kind}.yaml").read_text("utf-8")) for kind in _FILES}
    return [
        (tuple(group["keywords"]), [{**files["common"]["slots"], **file["slots"]}[slot] for slot in group["sentence"]])
        for file in files.values()
        for group in file["groups"]
    ]


def _groups(name: str, split: Split) -> tuple[_Group, ...]:
    keyword = KEYWORDS[name]
    words = {"dir": keyword.manoeuvres[0].name.lower(), "then": keyword.manoeuvres[-1].name.lower()}
    if keyword.type == "ordinal":
        words["nth"] = name.split(maxsplit=1)[0]
    return tuple(
        tuple(tuple(part.format(**words) for part in slot[split]) for slot in slots)
        for keywords, slots in _templates()
        if name in keywords
    )
