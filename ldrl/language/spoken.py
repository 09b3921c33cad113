"""What the training commands are made of: the parts of spoken.yaml, and the words of them all."""

from __future__ import annotations

from collections import Counter
from functools import cache
from importlib import resources
from typing import Any

import yaml

from ldrl.language.keywords import KEYWORDS
from ldrl.language.sentences import Sentences

__all__ = ["MEANINGFUL", "loosely", "spoken", "training_words"]

MEANINGFUL = frozenset(
    [
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
        "couple",
    ]
)
"""Words that say which way and how often: never left out or stammered, but they may be misspelt."""


@cache
def spoken() -> dict[str, Any]:
    """The parts by slot, the ways to put a keyword loosely, slips and spare words."""
    text = (resources.files(__package__) / "spoken.yaml").read_text("utf-8")
    # Ten times as fast as in Python, where there is libyaml.
    return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


@cache
def loosely(name: str) -> list[list[str]]:
    """The slots of each way to put a keyword loosely."""
    return [slots for group in spoken()["groups"] if name in group["keywords"] for slots in group["sentences"]]


@cache
def training_words() -> tuple[str, ...]:
    """All words of the commands to train on: those that say which way and how often, those of the templates, others.

    Among each, the words that stand in the most parts of commands come first.
    """
    template = {part for name in KEYWORDS for part in Sentences("train").parts(name)}
    used = {slot.strip("()").partition(":")[0] for name in KEYWORDS for slots in loosely(name) for slot in slots}
    loose = [
        part.format(dir="", then="", other="")
        for slot in used - {"before", "after"}
        for part in spoken()["slots"][slot]
    ]
    usual, others = (Counter(word for part in parts for word in part.split()) for parts in (template, loose))
    known = usual + others
    order = sorted(known, key=lambda word: (word not in MEANINGFUL, word not in usual, -known[word], word))
    return tuple(order)
