"""Encoders of the two inputs: the image and the instruction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ldrl.language import DIMENSIONS, PADDING, Likeness, Tokenizer, WordEmbedding
from ldrl.language.spoken import training_words

__all__ = ["ImageEncoder", "InstructionEncoder"]

KERNELS = ((8, 4), (4, 2), (4, 2))
"""Kernel size and stride of each convolution (paper's implementation); 88x200 becomes 3x10, 48x200 becomes 1x10."""

ROAD_PATCH = (slice(-10, None), slice(60, 140))
"""Rows and columns of the image that show the road just in front of the car, 4 to 5 m from the camera."""


class ImageEncoder(nn.Module):
    """Three convolutions, each normalised over all channels and places (group norm of one group), with ELU.

    An image in colour is taken relative to the mean colour of the road in front of the car and to its own contrast, so
    that neither the light nor the asphalt of a town matters much (as in Dahlkamp et al. 2006, who learn the road's look
    from that patch).

    Args:
        in_channels: channels of the image.
        channels: channels after each convolution, ``C'`` the last.
        rows: how many of the image's rows are looked at, from the bottom up. The road is in the lower half; without
            the rest the encoder trains three times as fast.

    Attributes:
        out_features: ``C' H W``, the size of a flattened encoding.

    Raises:
        ValueError: ``rows`` is not in 44 to 88.

    Examples:
        >>> ImageEncoder(1, (4, 4, 8))(torch.zeros(2, 5, 1, 88, 200, dtype=torch.uint8)).shape
        torch.Size([2, 5, 8, 3, 10])
    """

    def __init__(self, in_channels: int, channels: Sequence[int], rows: int = 88) -> None:
        super().__init__()
        self.rows = rows
        height, width = rows, 200
        layers: list[nn.Module] = []
        for channel, (kernel, stride) in zip(channels, KERNELS, strict=True):
            layers += [nn.Conv2d(in_channels, channel, kernel, stride), nn.GroupNorm(1, channel), nn.ELU()]
            in_channels = channel
            height, width = ((size - kernel) // stride + 1 for size in (height, width))
        if height < 1 or rows > 88:
            raise ValueError(f"rows is {rows}; an image has 88, and the convolutions need at least 44 of them")
        self.out_features = in_channels * height * width
        # Channels last trains more than twice as fast on a CPU.
        self.layers = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, image: Tensor) -> Tensor:
        """Encode images.

        Args:
            image: ``[*B, C, 88, 200]`` uint8.

        Returns:
            ``[*B, C', H, W]`` float32.
        """
        image = image[..., -self.rows :, :]
        flat = image.reshape(-1, *image.shape[-3:]).contiguous(memory_format=torch.channels_last)
        flat = flat.to(self.layers[0].weight.dtype).div_(255)
        # The road itself is known by one channel.
        features = self.layers(flat) if flat.shape[1] == 1 else self.layers[1:](self._relative(flat))
        return features.reshape(*image.shape[:-3], *features.shape[1:])

    def _relative(self, image: Tensor) -> Tensor:
        """What the first convolution makes of ``(image - road) / contrast``, worked out on its fewer pixels."""
        first = self.layers[0]
        road = image[..., *ROAD_PATCH].mean((-2, -1))
        contrast = image[..., ::4, ::4].std((-3, -2, -1), keepdim=True) + 0.03
        absolute = functional.conv2d(image, first.weight, stride=first.stride)
        offset = road @ first.weight.sum((-2, -1)).T
        return (absolute - offset[..., None, None]) / contrast + first.bias[:, None, None]


class InstructionEncoder(nn.Module):
    """Frozen GloVe vectors, with learned ones of usual words, through a single-layer GRU that reads both ways.

    GloVe holds left and right, or first and second, for nearly the same; so the words that training commands use most
    have a second vector, which is learned, and each word is known by what it looks and sounds like, too. In training
    GloVe's vectors are disturbed and some of either kind left out, so that words that are alike, look or sound alike
    come to count alike and a sentence is understood that was never trained on.

    Args:
        hidden: size of a word's state, half of it of the GRU that reads backwards; an even number.
        noise: standard deviation of Gaussian noise on GloVe's vectors in training.
        dropout: probability in training that a component of a GloVe vector is left out, a word's whole GloVe vector, or
            its learned one.
        usual: how many words have a learned vector; it is zero for all others.
        learned: size of the learned vectors.

    Examples:
        >>> states, is_word = InstructionEncoder(32)(torch.tensor([[5, 6, 0, 0]]))
        >>> states.shape, is_word
        (torch.Size([1, 2, 32]), tensor([[True, True]]))
    """

    usual_tokens: Tensor

    def __init__(
        self, hidden: int, noise: float = 0.15, dropout: float = 0.1, usual: int = 1000, learned: int = 16
    ) -> None:
        super().__init__()
        self.embedding = WordEmbedding()
        # Some words are read as others, so that there are fewer tokens than words.
        words = training_words()
        tokens = list(dict.fromkeys(Tokenizer(2 * len(words))([" ".join(words)])[0].tolist()))[:usual]
        # Saved with the weights: other training commands may have other usual words.
        self.register_buffer("usual_tokens", torch.tensor(sorted(tokens)))
        self.learned = nn.Embedding(usual + 1, learned, padding_idx=0)
        self.likeness = Likeness()
        self.noise = noise
        self.dropout = nn.Dropout(dropout)
        # Two instead of one that is bidirectional: on padded sequences, packed ones train four times as long on a CPU.
        known = DIMENSIONS + learned + self.likeness.out_features
        self.forward_gru = nn.GRU(known, hidden // 2, batch_first=True)
        self.backward_gru = nn.GRU(known, hidden // 2, batch_first=True)

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Encode instructions.

        Args:
            tokens: ``[*B, L]`` int64, 0 is padding and only at the end.

        Returns:
            The GRU's state after each word, ``[*B, W, hidden]`` float32, zero for padding, and where there is a
            word, ``[*B, W]`` bool; ``W`` is the number of words of the longest instruction, 1 if none has any.
        """
        length = (tokens != PADDING).sum(-1).flatten()
        longest = max([1, *length.tolist()])
        flat = tokens[..., :longest].reshape(-1, longest)
        is_word = flat != PADDING
        vectors = self.embedding(flat)
        place = torch.searchsorted(self.usual_tokens, flat.contiguous()).clamp(max=len(self.usual_tokens) - 1)
        usual = self.usual_tokens[place] == flat
        if self.training:
            vectors = self.dropout(vectors + self.noise * torch.randn_like(vectors))
            kept = torch.rand(2, *usual.shape, device=flat.device) >= self.dropout.p
            usual, vectors = usual & kept[0], vectors * kept[1].unsqueeze(-1)
        vectors = torch.cat((vectors, self.learned((place + 1) * usual), self.likeness(flat)), -1)
        from_end = (length.unsqueeze(-1) - 1 - torch.arange(longest, device=flat.device)).clamp(min=0).unsqueeze(-1)
        onward, _ = self.forward_gru(vectors)
        backward, _ = self.backward_gru(vectors.take_along_dim(from_end, 1))
        states = torch.cat((onward, backward.take_along_dim(from_end, 1)), -1) * is_word.unsqueeze(-1)
        size = (*tokens.shape[:-1], longest)
        return states.view(*size, states.shape[-1]), is_word.view(size)
