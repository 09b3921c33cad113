"""How much words look and sound like those that matter."""

from __future__ import annotations

from functools import cache, partial

import jellyfish
import numpy as np
import torch
from rapidfuzz import process
from rapidfuzz.distance import OSA
from torch import Tensor, nn

from ldrl.language.glove import SPECIAL_ROWS, load_glove
from ldrl.language.spoken import MEANINGFUL

__all__ = ["Likeness"]


class Likeness(nn.Module):
    """How much each word of GloVe looks, and sounds, like each of the words that say which way and how often.

    The first half is the similarity of the spelling (1 minus edits by letters of the longer word, optimal string
    alignment), the other that of the sound, by Metaphone codes (Philips 1990): "strayed" looks 0.5 and sounds 0.8 like
    "straight". So what was taken for another word can be read although nobody ever took it for that one. As in
    :class:`~ldrl.language.WordEmbedding`, the table is neither parameter nor buffer, and all instances share it.

    Examples:
        >>> Likeness()(torch.tensor([[0, 1, 2]])).shape
        torch.Size([1, 3, 28])
    """

    out_features = 2 * len(MEANINGFUL)
    """Numbers for a word."""

    def forward(self, tokens: Tensor) -> Tensor:
        """Looks words up.

        Args:
            tokens: ids, any shape, int64.

        Returns:
            Similarities from 0 to 1, ``[*tokens.shape, out_features]`` float32, zero for padding and unknown words.
        """
        return nn.functional.embedding(tokens, _table_on(tokens.device))


# Without the decorator torch.compile would trace how the table is made.
@torch.compiler.assume_constant_result
def _table_on(device: torch.device) -> Tensor:
    return _copy(device)


@cache
def _copy(device: torch.device) -> Tensor:
    return _table().to(device)


@cache
def _table() -> Tensor:
    words, meant = list(load_glove().words), sorted(MEANINGFUL)
    alike = partial(process.cdist, scorer=OSA.normalized_similarity, dtype=np.float32)
    halves = [alike([code(w) for w in words], [code(w) for w in meant]) for code in (str, jellyfish.metaphone)]
    table = torch.zeros(SPECIAL_ROWS + len(words), Likeness.out_features)
    table[SPECIAL_ROWS:] = torch.from_numpy(np.concatenate(halves, 1))
    return table
