"""The 14 keywords that instructions stand for, each an automaton over junctions.

A sentence says one keyword. What that keyword asks for depends on the junctions that the car meets: "second left"
passes one street on the left, however many junctions that takes. Planning routes, labelling states and the safe answer
to instructions that the map does not allow all run the same automaton, :meth:`Keyword.step`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ldrl.subtasks import SubTask

__all__ = ["KEYWORDS", "SAFE_KEYWORDS", "Keyword", "realised_by"]


@dataclass(frozen=True)
class Keyword:
    """What an instruction asks for, as an automaton whose input is what each junction offers.

    Args:
        name: the canonical name, a key of :data:`KEYWORDS`.
        type: ``"single"`` and ``"double"`` name the manoeuvre at each of the next one or two junctions;
            ``"ordinal"`` counts the streets on one side and goes straight until the one that is meant.
        manoeuvres: the manoeuvres that the name mentions, in order; one for an ordinal.
        count: the state in which the keyword is done: manoeuvres to make, or for an ordinal streets to count.
        safe: what to do where the junction does not allow what is asked for. True goes straight instead of an
            impossible turn and stops (``FINISH``) where straight on is impossible (paper's safe behaviour); False
            gives up.

    Examples:
        >>> keyword = Keyword.parse("(First, left)")
        >>> keyword.name, keyword.type
        ('first left', 'ordinal')
        >>> manoeuvre, state = keyword.step(keyword.start, {SubTask.RIGHT, SubTask.STRAIGHT})
        >>> manoeuvre.name, keyword.done(state)
        ('STRAIGHT', False)
        >>> manoeuvre, state = keyword.step(state, {SubTask.LEFT, SubTask.RIGHT})
        >>> manoeuvre.name, keyword.done(state)
        ('LEFT', True)
        >>> SAFE_KEYWORDS["left"].step(0, {SubTask.RIGHT, SubTask.STRAIGHT})[0].name
        'STRAIGHT'
        >>> SAFE_KEYWORDS["straight"].step(0, {SubTask.LEFT, SubTask.RIGHT})[0].name
        'FINISH'
    """

    name: str
    type: Literal["single", "double", "ordinal"]
    manoeuvres: tuple[SubTask, ...]
    count: int
    safe: bool = False

    @classmethod
    def parse(cls, value: str | Keyword) -> Keyword:
        """Finds the keyword that a spelling such as ``"(First, left)"``, ``"left right"`` or ``"left_right"`` means.

        Args:
            value: the words of the keyword in order, whatever their case and the separators around them; a
                keyword is returned as it is.

        Returns:
            The keyword of :data:`KEYWORDS`, or the one that was given.

        Raises:
            ValueError: no keyword has these words.
        """
        if isinstance(value, Keyword):
            return value
        words = tuple(re.sub(r"[\s,_()'\"-]+", " ", value).lower().split())
        if words not in _BY_WORDS:
            names = ", ".join(f"'{name}'" for name in KEYWORDS)
            raise ValueError(f"unknown keyword {value!r}: use one of {names}")
        return _BY_WORDS[words]

    @property
    def start(self) -> int:
        """The state before the first junction, always 0."""
        return 0

    def done(self, state: int) -> bool:
        """Tells whether nothing is left to do in this state."""
        return state >= self.count

    def step(self, state: int, options: Collection[SubTask]) -> tuple[SubTask, int] | None:
        """Decides at one junction.

        Args:
            state: :attr:`start` at the first junction, after that what the previous step returned.
            options: the manoeuvres that the junction offers on the car's approach.

        Returns:
            The manoeuvre that the instruction asks for and the next state. Where the junction does not allow it: None,
            or with ``safe`` the safe answer, after which a stop is done and ``STRAIGHT`` goes on to what comes next.

        Raises:
            ValueError: the keyword is done in this state, so it asks for nothing.
        """
        if self.done(state):
            raise ValueError(f"'{self.name}' is done in state {state} and asks for nothing: check done(state) first")
        if self.type == "ordinal":
            turn = self.manoeuvres[0]
            state += turn in options
            manoeuvre = turn if self.done(state) else SubTask.STRAIGHT
        else:
            manoeuvre = self.manoeuvres[state]
            state += 1
        if manoeuvre in options:
            return manoeuvre, state
        if not self.safe:
            return None
        return (SubTask.STRAIGHT, state) if SubTask.STRAIGHT in options else (SubTask.FINISH, self.count)


def realised_by(
    manoeuvres: Sequence[SubTask],
    options: Sequence[Collection[SubTask]],
    keywords: Iterable[Keyword] | None = None,
) -> list[Keyword]:
    """Lists the keywords that ask for exactly these manoeuvres at these junctions, done at the last one.

    Args:
        manoeuvres: what the car does at each junction, in order.
        options: what each of these junctions offers.
        keywords: those to look through; by default :data:`KEYWORDS`.

    Returns:
        The keywords in their order; none for no junction.

    Raises:
        ValueError: there are not as many manoeuvres as junctions.

    Examples:
        >>> L, R, S = SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT
        >>> [keyword.name for keyword in realised_by([S, L], [{S, R}, {L, S}])]
        ['first left']
        >>> [keyword.name for keyword in realised_by([L], [{L, S}])]
        ['left', 'first left']
    """
    if len(manoeuvres) != len(options):
        raise ValueError(f"{len(manoeuvres)} manoeuvres at {len(options)} junctions: give the options of each junction")
    keywords = KEYWORDS.values() if keywords is None else keywords
    return [keyword for keyword in keywords if _chooses(keyword, manoeuvres, options)]


def _chooses(keyword: Keyword, manoeuvres: Sequence[SubTask], options: Sequence[Collection[SubTask]]) -> bool:
    state = keyword.start
    for manoeuvre, offered in zip(manoeuvres, options, strict=True):
        if keyword.done(state):
            return False
        decision = keyword.step(state, offered)
        if decision is None or decision[0] != manoeuvre:
            return False
        state = decision[1]
    return keyword.done(state)


def _keyword(name: str) -> Keyword:
    if name.startswith(("first", "second")):
        ordinal, turn = name.split(" ")
        return Keyword(name, "ordinal", (SubTask[turn.upper()],), 1 if ordinal == "first" else 2)
    manoeuvres = tuple(SubTask[word.upper()] for word in name.split(","))
    return Keyword(name, "single" if len(manoeuvres) == 1 else "double", manoeuvres, len(manoeuvres))


KEYWORDS: dict[str, Keyword] = {
    name: _keyword(name)
    for name in (
        "left",
        "right",
        "straight",
        "left,left",
        "left,right",
        "left,straight",
        "right,left",
        "right,right",
        "right,straight",
        "straight,straight",
        "first left",
        "first right",
        "second left",
        "second right",
    )
}
"""Every keyword by its canonical name."""

SAFE_KEYWORDS: dict[str, Keyword] = {
    name: replace(keyword, safe=True) for name, keyword in KEYWORDS.items() if keyword.type != "ordinal"
}
"""Singles and doubles with a safe answer to what the map does not allow; an ordinal waits for its street instead."""

_BY_WORDS = {tuple(name.replace(",", " ").split()): keyword for name, keyword in KEYWORDS.items()}
