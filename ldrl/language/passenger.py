"""How passengers speak: training sentences and looser phrasings, with slips, corrections and talk around them."""

from __future__ import annotations

import random
import string
from collections.abc import Callable
from functools import cache, partial

from ldrl.language.families import Families
from ldrl.language.keywords import KEYWORDS, Keyword
from ldrl.language.sentences import Sentences
from ldrl.language.spoken import MEANINGFUL, loosely, spoken
from ldrl.language.tokens import Tokenizer

__all__ = ["Passenger"]

FREQUENT = 20_000
"""How many of the most frequent words can be put into a sentence at random."""
LOOSE = 0.6
"""Share of commands that are put in a looser phrasing than the templates'."""
OPTIONAL = 0.2
"""Probability that a loose phrasing has a part that it may leave out."""
CLEAN = 0.2
"""Share of commands that are said without anything around them."""
SHORTENED = 0.3
"""Share of the other commands that leave out what their meaning does not need."""
CORRECTED, FILLED, TALKED, REPEATED, SLIPPED, DISTURBED = 0.15, 0.3, 0.35, 0.15, 0.25, 0.4
"""Shares of them with a self-correction, fillers, talk around them, a repetition, slips of the tongue, the typing hand
or the speech recogniser, and words dropped, replaced or inserted at random."""
DENIED = 0.3
"""Share of repetitions that go on with what is not meant."""
RATE = 0.1
"""Probability that a word is dropped, replaced, or has another before it, in a sentence so disturbed."""
DENIALS = ("not", "and not", "but not", "don t", "never", "rather than", "instead of")
TURNING_ROUND = ("after", "before", "once")
NEGATIONS = ("no", "not", "don", "never")
DECISIVE = MEANINGFUL.union(
    TURNING_ROUND, NEGATIONS, ("skip", "pass", "past", "without", "neither", "opposite", "other")
)
"""Words that are not dropped, replaced or inserted at random: they would make another command of one."""
DIRECTIONS = ("left", "right", "straight")
ORDINALS = ("first", "second")


class Passenger:
    """Says keywords for training, each time in another way.

    What a listener would read as a held-out sentence, or as one of the family ``ambiguity``, is never said, except
    single words. The sentences of the other families are too many to know them all.

    Args:
        tokenizer: of who listens: random words come from its vocabulary, and no sentence is longer than it keeps.

    Examples:
        >>> Passenger().say("left", random.Random(6))
        'you should take a left turn'
        >>> Passenger().nonsense(random.Random(13))
        'let me check the map'
    """

    def __init__(self, tokenizer: Tokenizer | None = None) -> None:
        self.tokenizer = Tokenizer() if tokenizer is None else tokenizer
        self._sentences = Sentences("train")
        # GloVe's rows are sorted by frequency: what people say is among the first.
        frequent = list(self.tokenizer.glove.words)[:FREQUENT]
        self._words = [word for word in frequent if word.isalpha() and word not in DECISIVE]

    def say(self, keyword: str | Keyword, rng: random.Random) -> str:
        """Say a keyword.

        Args:
            keyword: what is meant, in any spelling that :meth:`Keyword.parse` knows.
            rng: the source of randomness; nothing else decides.

        Returns:
            A sentence of 1 to ``tokenizer.max_tokens`` words.
        """
        keyword = Keyword.parse(keyword)
        while True:
            sentence = self._say(keyword, rng)
            if " ".join(self.tokenizer.read(sentence)) not in _unsaid():
                return sentence

    def _say(self, keyword: Keyword, rng: random.Random) -> str:
        plain = self._phrase(keyword, rng)
        words = plain.split()
        if rng.random() < CLEAN:
            return plain
        if rng.random() < SHORTENED:
            words = self._shorten(keyword, words, rng)
        happens = [rng.random() < share for share in (CORRECTED, DISTURBED, REPEATED, FILLED, TALKED, SLIPPED)]
        repeat = partial(self._repeat, keyword)
        changes: list[Callable] = [self._correct, self._disturb, repeat, self._fill, self._talk, self._slip]
        for happened, change in zip(happens, changes, strict=True):
            if happened:
                words = change(words, rng)
        sentence = " ".join(words)
        return sentence if 0 < len(sentence.split()) <= self.tokenizer.max_tokens else plain

    def nonsense(self, rng: random.Random) -> str:
        """Talk that asks for nothing, or 1 to 12 known and unknown words at random."""
        talk = rng.choice(spoken()["slots"]["talk"])
        if len(talk.split()) > 2 and rng.random() < 0.3:
            return talk
        unknown = rng.random()
        words = rng.choices(self._words, k=rng.randint(1, 12))
        return " ".join("zzyzzyx" if rng.random() < unknown else word for word in words)

    def _phrase(self, keyword: Keyword, rng: random.Random) -> str:
        if rng.random() >= LOOSE:
            return self._sentences.sample(keyword, rng)
        parts = []
        for slot in rng.choice(loosely(keyword.name)):
            name, _, of_then = slot.strip("()").partition(":")
            if not slot.startswith("(") or rng.random() < OPTIONAL:
                then = keyword.manoeuvres[-1].name.lower()
                said = then if of_then else keyword.manoeuvres[0].name.lower()
                words = {"dir": said, "then": then, "other": "right" if said == "left" else "left"}
                parts.append(rng.choice(spoken()["slots"][name]).format(**words))
        return " ".join(parts)

    def _shorten(self, keyword: Keyword, words: list[str], rng: random.Random) -> list[str]:
        """Leave out what the meaning does not need.

        If the keyword's own words say it, in its order, these are enough. Else only ``spare`` words can go, and only if
        there is a direction for the others to speak of.
        """
        own = keyword.name.replace(",", " ").split()
        meant, said = ([word for word in text if word in DIRECTIONS] for text in (own, words))
        # "Just a second, then go left" must not come to "second left". Two steps may be counted as they like.
        of = {"single": MEANINGFUL, "double": frozenset(), "ordinal": frozenset(ORDINALS)}[keyword.type]
        counted = of.intersection(words) == of.intersection(own)
        rate = rng.uniform(0.3, 1)
        if said != meant or not counted or not set(words).isdisjoint(NEGATIONS):
            spare = spoken()["spare"] if said else ()
            return [word for word in words if word not in spare or rng.random() >= rate]
        # "Left and after that right" must not come to "left after right".
        return [word for word in words if word in MEANINGFUL or (rng.random() >= rate and word not in TURNING_ROUND)]

    def _disturb(self, words: list[str], rng: random.Random) -> list[str]:
        """Drop, replace and insert words that do not say which way or how often."""
        disturbed = []
        for word in words:
            if rng.random() < RATE:
                disturbed.append(rng.choice(self._words))
            chance = rng.random()
            if word in DECISIVE or chance >= 2 * RATE:
                disturbed.append(word)
            elif chance < RATE:
                disturbed.append(rng.choice(self._words))
        return disturbed or words

    def _correct(self, words: list[str], rng: random.Random) -> list[str]:
        """Say something wrong first, and take it back: the last word counts."""
        marker = rng.choice(spoken()["slots"]["corrections"]).split()
        spots = [k for k, word in enumerate(words) if word in DIRECTIONS or word in ORDINALS]
        if not spots or rng.random() < 0.3:
            wrong = self._phrase(rng.choice(list(KEYWORDS.values())), rng).split()
            return wrong[: rng.randint(1, len(wrong))] + marker + words
        spot = rng.choice(spots)
        others = DIRECTIONS if words[spot] in DIRECTIONS else ORDINALS
        wrong_word = rng.choice([word for word in others if word != words[spot]])
        before = rng.randint(0, min(spot, 3))  # words said again in the second try
        return [*words[:spot], wrong_word, *marker, *words[spot - before :]]

    def _repeat(self, keyword: Keyword, words: list[str], rng: random.Random) -> list[str]:
        """Say it again, in the same words, and perhaps what is not meant."""
        again = words + rng.choice(spoken()["slots"]["confirmations"]).split() + words
        if rng.random() < DENIED:
            another = rng.choice([other for other in KEYWORDS.values() if other.name != keyword.name])
            again += rng.choice(DENIALS).split() + self._phrase(another, rng).split()
        return again

    def _fill(self, words: list[str], rng: random.Random) -> list[str]:
        """Fill pauses, or stammer."""
        for _ in range(rng.randint(1, 3)):
            spot = rng.randint(0, len(words))
            stammers = spot < len(words) and words[spot] not in MEANINGFUL and rng.random() < 0.3
            said = [words[spot]] if stammers else rng.choice(spoken()["slots"]["fillers"]).split()
            words = words[:spot] + said + words[spot:]
        return words

    def _talk(self, words: list[str], rng: random.Random) -> list[str]:
        """Talk of other things before, after or between, with direction words in another sense."""
        for _ in range(rng.randint(1, 2)):
            said = rng.choice(spoken()["slots"]["talk"]).split()
            spot = rng.choice((0, 0, len(words), rng.randint(0, len(words))))
            back = rng.choice(spoken()["slots"]["fillers"]).split() if 0 < spot < len(words) else []
            words = words[:spot] + said + back + words[spot:]
        return words

    def _slip(self, words: list[str], rng: random.Random) -> list[str]:
        """Misspell one or two words, or hear others that sound like them."""
        words = list(words)
        crucial = [k for k, word in enumerate(words) if word in MEANINGFUL]
        spots = rng.sample(range(len(words)), min(len(words), rng.randint(1, 2)))
        if crucial and rng.random() < 0.6:
            spots.append(rng.choice(crucial))
        for spot in dict.fromkeys(spots):
            heard = spoken()["slips"].get(words[spot])
            words[spot] = rng.choice(heard) if heard and rng.random() < 0.5 else _misspell(words[spot], rng)
        return words


def _misspell(word: str, rng: random.Random) -> str:
    """One edit: a letter dropped, doubled, replaced, or swapped with its neighbour."""
    k = rng.randrange(len(word))
    if len(word) < 3:
        return word
    return rng.choice(
        (
            word[:k] + word[k + 1 :],
            word[:k] + word[k] + word[k:],
            word[:k] + rng.choice(string.ascii_lowercase) + word[k + 1 :],
            word[:k] + word[k + 1 : k + 2] + word[k] + word[k + 2 :],
        )
    )


@cache
def _unsaid() -> frozenset[str]:
    """The sentences of tests, as far as all of them can be listed, as they are read."""
    tests = (Sentences("heldout"), Families("ambiguity"))
    read = Tokenizer().read
    sentences = {" ".join(read(sentence)) for test in tests for name in KEYWORDS for sentence in test.all(name)}
    return frozenset(sentence for sentence in sentences if " " in sentence)
