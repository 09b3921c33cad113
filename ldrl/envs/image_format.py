"""In which form images go into a segmentation network."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

__all__ = ["PREPROCESSING", "ImageFormat"]

PREPROCESSING = "preprocessor_config.json"
"""The file beside the weights that tells it."""


@dataclass(frozen=True)
class ImageFormat:
    """In which form images go into a network: the part that a ``preprocessor_config.json`` of ``transformers`` tells.

    A centre crop is not made: it would take the sides of the road away, and the network is convolutional.

    Args:
        size: rows and columns after scaling; None leaves images as they are.
        shortest: rows or columns after scaling, whichever are fewer, in place of ``size``.
        mean: of each colour, subtracted from values in [0, 1].
        std: of each colour, divided by.
        first_row: the first row of the dash camera's image that the network sees; no road can show above it.
    """

    size: tuple[int, int] | None = None
    shortest: int | None = None
    mean: tuple[float, float, float] = (0.5, 0.5, 0.5)
    std: tuple[float, float, float] = (0.5, 0.5, 0.5)
    first_row: int = 0

    @classmethod
    def read(cls, path: str | Path) -> ImageFormat:
        """Read a ``preprocessor_config.json``."""
        told = json.loads(Path(path).read_text(encoding="utf-8"))
        normal = {} if not told.get("do_normalize", True) else told
        size = told.get("size", {}) if told.get("do_resize", True) else {}
        size = {"shortest_edge": size} if isinstance(size, int) else size
        return cls(
            size=(size["height"], size["width"]) if "height" in size else None,
            shortest=size.get("shortest_edge"),
            mean=tuple(normal.get("image_mean", (0.0,) * 3)),
            std=tuple(normal.get("image_std", (1.0,) * 3)),
            first_row=told.get("first_row", 0),
        )

    def write(self, path: str | Path) -> None:
        """Write what :meth:`read` reads."""
        size = {"shortest_edge": self.shortest} if self.shortest else {}
        told = {
            "image_processor_type": "MobileNetV2ImageProcessor",
            "do_resize": bool(self.size or self.shortest),
            "size": dict(zip(("height", "width"), self.size, strict=True)) if self.size else size,
            "do_center_crop": False,
            "do_rescale": True,
            "rescale_factor": 1 / 255,
            "do_normalize": True,
            "image_mean": self.mean,
            "image_std": self.std,
            "first_row": self.first_row,
        }
        Path(path).write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")

    def pixels(self, images: Tensor) -> Tensor:
        """What the network reads.

        Args:
            images: ``[N, 3, 88, 200]`` uint8.

        Returns:
            ``[N, 3, rows, columns]`` float32, in the memory format that convolutions are fastest in.
        """
        pixels = images[:, :, self.first_row :].contiguous(memory_format=torch.channels_last)
        rows, columns = pixels.shape[-2:]
        scale = self.shortest / min(rows, columns) if self.shortest else 1.0
        size = self.size or (round(rows * scale), round(columns * scale))
        if size != (rows, columns):
            pixels = (
                pixels if pixels.is_cpu else pixels.float()
            )  # bytes scale in a tenth of the time, but on a CPU only
            pixels = interpolate(pixels, size, mode="bilinear", antialias=True)
        std, mean = (pixels.new_tensor(of, dtype=torch.float32).view(3, 1, 1) for of in (self.std, self.mean))
        return pixels.float().mul_(1 / 255 / std).sub_(mean / std)
