"""Attention: over the words of the instruction, and over the channels of the image; and what does without."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Concatenation", "GatedAttention", "LastWord", "LuongAttention"]


class LuongAttention(nn.Module):
    """Luong et al. (2015), general score: ``linear(encoder state) . decoder state``, and what a word counts by itself.

    The latter is for the first decision, when the decoder's state is zero: without it all words would count the same.

    Args:
        encoder: size of an encoder state.
        decoder: size of the decoder state.
    """

    def __init__(self, encoder: int, decoder: int) -> None:
        super().__init__()
        self.score = nn.Linear(encoder, decoder, bias=False)
        self.relevance = nn.Linear(encoder, 1, bias=False)

    def forward(self, states: Tensor, is_word: Tensor, decoder: Tensor) -> Tensor:
        """Attend to words.

        Args:
            states: encoder states, ``[*B, L, E]`` float32.
            is_word: ``[*B, L]`` bool; False is left out.
            decoder: decoder state, ``[*B, D]`` float32.

        Returns:
            ``[*B, E]`` float32, the weighted mean of the states; zero where there is no word.
        """
        # The same as score(states) @ decoder, but one product per row instead of one per word.
        query = decoder @ self.score.weight + self.relevance.weight
        score = (states @ query.unsqueeze(-1)).squeeze(-1)
        # A large finite number, so that a row without words has weights and no NaN.
        weights = score.masked_fill(~is_word, -1e9).softmax(-1) * is_word
        return (weights.unsqueeze(-2) @ states).squeeze(-2)


class GatedAttention(nn.Module):
    """Chaplot et al. (2018): one weight per image channel from the instruction, multiplied in.

    Args:
        condition: size of the instruction vector.
        channels: channels of the image features.
    """

    def __init__(self, condition: int, channels: int) -> None:
        super().__init__()
        self.gate = nn.Linear(condition, channels)

    def forward(self, features: Tensor, condition: Tensor) -> Tensor:
        """Gate features.

        Args:
            features: ``[*B, C, H, W]`` float32.
            condition: ``[*B, N]`` float32.

        Returns:
            ``[*B, C, H, W]`` float32.
        """
        return features * self.gate(condition).sigmoid()[..., None, None]


class LastWord(nn.Module):
    """The instruction encoder's last states: what a model without attention knows of the sentence."""

    def forward(self, states: Tensor, is_word: Tensor) -> Tensor:
        """Pick the states.

        Args:
            states: encoder states, ``[*B, L, E]`` float32.
            is_word: ``[*B, L]`` bool; True first.

        Returns:
            ``[*B, E]`` float32, the state of the forward direction behind the last word and that of the backward
            direction before the first; zero where there is no word.
        """
        length = is_word.sum(-1, keepdim=True)
        forward, backward = states.chunk(2, -1)
        last = forward.take_along_dim((length - 1).clamp(min=0).unsqueeze(-1), -2).squeeze(-2)
        return torch.cat((last, backward[..., 0, :]), -1) * (length > 0)


class Concatenation(nn.Module):
    """Image features and the instruction side by side: the fusion of a model without attention."""

    def forward(self, features: Tensor, condition: Tensor) -> Tensor:
        """Concatenate.

        Args:
            features: ``[*B, C, H, W]`` float32.
            condition: ``[*B, N]`` float32.

        Returns:
            ``[*B, C H W + N]`` float32.
        """
        return torch.cat((features.flatten(-3), condition), -1)
