"""How much words look and sound like those that matter."""

from __future__ import annotations

from functools import cache, partial

import jellyfish
import numpy as np
import torch
from rapidfuzz import process
from rapidfuzz.distance import OSA
from torch import Tensor, nn

from ldrl.language.glove import SPECIAL_ROWS, Glove, load_glove
from ldrl.language.spoken import MEANINGFUL

__all__ = ["Likeness"]


class Likeness(nn.Module):
    """How much each word looks, and sounds, like each of the words that say which way and how often.

    The first half is the similarity of the spelling (1 minus the share of letters to edit, optimal string alignment),
    the other that of the sound, by Metaphone codes (Philips 1990): "strayed" looks 0.5 and sounds 0.8 like "straight".
    So what was misspelt or misheard can be read although nobody ever misspelt or misheard it so.

    Args:
        glove: the vocabulary; None for that of the package.
    """

    def __init__(self, glove: Glove | None = None) -> None:
        super().__init__()
        self.glove = load_glove() if glove is None else glove

    @property
    def out_features(self) -> int:
        """Numbers for a word."""
        return 2 * len(MEANINGFUL)

    def forward(self, tokens: Tensor) -> Tensor:
        """Looks words up.

        Args:
            tokens: ids, any shape, int64.

        Returns:
            Similarities from 0 to 1, ``[*tokens.shape, out_features]`` float32, zero for padding and unknown words.
        """
        return nn.functional.embedding(tokens, _table(self.glove, tokens.device))


@cache
def _table(glove: Glove, device: torch.device) -> Tensor:
    if device.type != "cpu":
        return _table(glove, torch.device("cpu")).to(device)
    words, meant = list(glove.words), sorted(MEANINGFUL)
    alike = partial(process.cdist, scorer=OSA.normalized_similarity, dtype=np.float32)
    halves = [alike([code(w) for w in words], [code(w) for w in meant]) for code in (str, jellyfish.metaphone)]
    table = torch.zeros(SPECIAL_ROWS + len(words), 2 * len(meant))
    table[SPECIAL_ROWS:] = torch.from_numpy(np.concatenate(halves, 1))
    return table
