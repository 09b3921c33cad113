"""Language: keywords, sentences that say them, tokens and word vectors."""

from __future__ import annotations

from ldrl.language.families import Families, Family
from ldrl.language.glove import DIMENSIONS, Glove, WordEmbedding, load_glove
from ldrl.language.keywords import KEYWORDS, SAFE_KEYWORDS, Keyword, realised_by
from ldrl.language.likeness import Likeness
from ldrl.language.passenger import Passenger
from ldrl.language.sentences import Sentences, Split
from ldrl.language.spoken import MEANINGFUL
from ldrl.language.tokens import MAX_TOKENS, PADDING, UNKNOWN, Tokenizer, normalise

__all__ = [
    "DIMENSIONS",
    "KEYWORDS",
    "MAX_TOKENS",
    "MEANINGFUL",
    "PADDING",
    "SAFE_KEYWORDS",
    "UNKNOWN",
    "Families",
    "Family",
    "Glove",
    "Keyword",
    "Likeness",
    "Passenger",
    "Sentences",
    "Split",
    "Tokenizer",
    "WordEmbedding",
    "load_glove",
    "normalise",
    "realised_by",
]
