"""Slips of the typing finger and of the speech recogniser, mild enough for a person to read through."""

from __future__ import annotations

import random

from ldrl.language.glove import load_glove

__all__ = ["CRUCIAL", "slip"]

CRUCIAL = frozenset(
    "left right straight first second next one two twice both another again once more let skip possible".split()
)
"""Words that say which way and how often: never dropped, never doubled, changed at most once each."""
DROPPABLE = frozenset("a the to you i d s ve we re at this could want like your hey uh well thanks".split())
"""Words that a listener does not miss."""
COMMON_WORDS = 40_000
"""A typo makes none of this many commonest words of GloVe, so that it reads as a typo."""
LEAST_LETTERS = {"typo": 4, "split": 6}
"""Shorter words would be beyond recognition."""

_MISHEARD = {
    "left": ["lefts", "leff"],
    "right": ["write", "rite", "wright"],
    "straight": ["strait", "straights", "straight a", "strate"],
    "first": ["1st", "firs", "furst"],
    "second": ["2nd", "seconds", "seconed"],
    "two": ["too", "to", "2"],
    "twice": ["twise"],
    "let": ["led"],
    "both": ["booth", "bothe"],
    "one": ["won"],
    "once": ["ones", "wants"],
    "more": ["moor", "mor"],
    "again": ["agen", "a gain"],
    "another": ["an other", "a nother"],
    "then": ["than"],
    "to": ["too", "ta"],
    "and": ["an", "end"],
    "the": ["da", "thee"],
    "a": ["uh", "ay"],
    "at": ["add", "it"],
    "hey": ["hay"],
    "hang": ["hank", "hung"],
    "turn": ["tern", "turned"],
    "turns": ["terns"],
    "take": ["steak", "taken"],
    "make": ["mike", "made"],
    "road": ["rode", "rowed"],
    "street": ["streets", "streat"],
    "intersection": ["inter section", "intersections", "intersecting"],
    "corner": ["coroner", "corners"],
    "afterwards": ["after words"],
    "after": ["aft her"],
    "followed": ["follow", "fallowed"],
    "by": ["buy", "bye"],
    "through": ["threw", "thru"],
    "across": ["a cross"],
    "on": ["own"],
    "all": ["awl"],
    "way": ["weigh"],
    "row": ["roe"],
    "it": ["et"],
    "this": ["these", "dis"],
    "that": ["dat"],
    "your": ["yore", "you"],
    "you": ["u", "ya"],
    "could": ["cud", "good"],
    "we": ["wee"],
    "carry": ["carrie"],
    "drive": ["drives"],
    "continue": ["continues"],
    "stay": ["stayed"],
    "ahead": ["a head"],
    "thanks": ["thanx", "tanks"],
    "possible": ["posable"],
    "side": ["sighed"],
    "hand": ["and"],
}
_KEYS = ("qwertyuiop", "asdfghjkl", "zxcvbnm")
_GLUE = "+"
"""Before a word: no space here."""
_MARKS = (",", "...", "!", ".", " -")


def slip(sentence: str, rng: random.Random) -> str:
    """Writes a sentence as a hurried typist or a poor microphone would.

    Each slip hits another word: a typo of one letter behind the first one, a word taken for one that sounds alike,
    two words run together, one cut in two, one dropped or doubled. Sentences of up to 4 words get one slip, of up to 9
    words one or two, longer ones up to three. Directions, ordinals and words that say how often are never dropped or
    doubled. On top come careless case and punctuation.

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
            slipped = _slip_word(words[position], position == 0, rng)
        words[position] = slipped
    return _scribble(" ".join(" ".join(words).replace(f" {_GLUE}", "").split()), rng)


def _slip_word(word: str, is_first: bool, rng: random.Random) -> str | None:
    """One slip in a word; None where the draw does not fit it."""
    kinds = [] if is_first else ["merge"]
    if word in _MISHEARD:
        kinds += ["misheard", "misheard"]
    kinds += [kind for kind, letters in LEAST_LETTERS.items() if len(word) >= letters for _ in range(2)]
    if word in DROPPABLE:
        kinds += ["drop"]
    if word not in CRUCIAL:
        kinds += ["double"]
    kind = rng.choice(kinds)
    if kind == "misheard":
        return rng.choice(_MISHEARD[word])
    if kind == "typo":
        return _typo(word, rng)
    if kind == "split":
        cut = rng.randint(2, len(word) - 2)
        return f"{word[:cut]} {word[cut:]}"
    return {"merge": _GLUE + word, "drop": "", "double": f"{word} {word}"}[kind]


def _typo(word: str, rng: random.Random) -> str | None:
    """Swaps, drops, doubles or replaces one letter, never the first."""
    k = rng.randrange(1, len(word))
    row = next(row for row in _KEYS if word[k] in row)
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
    """Careless case and punctuation, which say nothing."""
    words = sentence.split()
    if rng.random() < 0.5:
        words[rng.randrange(len(words))] += rng.choice(_MARKS)
    case = rng.choice((str, str, str.capitalize, str.upper, str.title))
    return case(" ".join(words))
