"""Language: keywords, sentences that say them, tokens and word vectors."""

from __future__ import annotations

from ldrl.language.disturb import MEANINGFUL, disturb
from ldrl.language.families import Families, Family
from ldrl.language.glove import DIMENSIONS, Glove, WordEmbedding, load_glove
from ldrl.language.keywords import KEYWORDS, Keyword, realised_by
from ldrl.language.sentences import Sentences, Split
from ldrl.language.tokens import MAX_TOKENS, PADDING, UNKNOWN, Tokenizer, normalise

__all__ = [
    "DIMENSIONS",
    "KEYWORDS",
    "MAX_TOKENS",
    "MEANINGFUL",
    "PADDING",
    "UNKNOWN",
    "Families",
    "Family",
    "Glove",
    "Keyword",
    "Sentences",
    "Split",
    "Tokenizer",
    "WordEmbedding",
    "disturb",
    "load_glove",
    "normalise",
    "realised_by",
]
