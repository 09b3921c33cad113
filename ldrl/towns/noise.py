"""Numbers and textures that look random, and are the same on every device and in every run."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor, nn

__all__ = ["TILE", "flecks", "hash_uniform", "slabs", "smooth_noise"]

TILE = 512
"""Edge of a texture that is laid out again and again, texels."""


def hash_uniform(*values: Tensor | int) -> Tensor:
    """Numbers in [0, 1) that look random and depend on nothing but the integers given.

    Args:
        values: ``[*B]`` int64 or numbers, broadcast together.

    Returns:
        ``[*B]`` float32.

    Examples:
        >>> bool(hash_uniform(torch.arange(1000), 7).mean().sub(0.5).abs() < 0.05)
        True
    """
    mixed = torch.tensor(0)
    for value in values:
        mixed = (mixed.to(value.device) if isinstance(value, Tensor) else mixed) ^ value
        for multiplier in (0x2545F4914F6CDD1D, 0x369DEA0F31A53F85):  # integers wrap around
            mixed = mixed * multiplier
            mixed = mixed ^ (mixed >> 31 & 0x1FFFFFFFF)
    return (mixed >> 16 & 0xFFFFFF).float() / 0x1000000


@lru_cache(maxsize=8)
def smooth_noise(seed: int) -> Tensor:
    """Smooth noise in [0, 1) with features of 8, 2 and 0.125 m, ``[TILE, TILE]``."""
    total = torch.zeros(TILE, TILE)
    for size, weight in ((64, 0.5), (16, 0.3), (1, 0.2)):
        nodes = hash_uniform(seed, size, torch.arange((TILE // size) ** 2)).view(1, 1, TILE // size, -1)
        nodes = nn.functional.pad(nodes, (0, 1, 0, 1), mode="circular")
        smooth = nn.functional.interpolate(nodes, (TILE + 1, TILE + 1), mode="bilinear", align_corners=True)
        total += weight * smooth[0, 0, :TILE, :TILE]
    return total


@lru_cache(maxsize=8)
def flecks(seed: int) -> Tensor:
    """A number in [0, 1) for each texel, ``[TILE, TILE]``."""
    return hash_uniform(seed, torch.arange(TILE * TILE)).view(TILE, TILE)


@lru_cache(maxsize=8)
def slabs(seed: int) -> Tensor:
    """A number in [0, 1) for each slab of 2 m, ``[TILE, TILE]``."""
    numbers = hash_uniform(seed, torch.arange((TILE // 16) ** 2)).view(TILE // 16, -1)
    return numbers.repeat_interleave(16, 0).repeat_interleave(16, 1)
