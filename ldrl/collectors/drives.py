"""Whole drives through segments, to train policies that act at every step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import Storage
from torchrl.envs import Compose, Transform

from ldrl import keys
from ldrl.collectors.segments import BoundarySampler
from ldrl.towns import Town

__all__ = ["DriveSampler", "OncePerFrame"]

BEHIND = 15
"""Frames behind the last manoeuvre that belong to a drive."""


class DriveSampler(BoundarySampler):
    """Draws drives from where an instruction is given to behind the last manoeuvre, as many of each keyword.

    The batch size of the buffer counts frames, padding included. Each gets the instruction's tokens and ``mask``, False
    for padding, which repeats the last frame. Sentences are those of a passenger in training.

    Args:
        buffer: demonstrations.
        town: where they were driven.
        length: frames of a sequence; longer drives are cut.
        seed: of the sampler's own generator.

    Raises:
        ValueError: no segment realises a keyword.
    """

    def __init__(self, buffer: TensorDictReplayBuffer, town: Town, length: int = 400, *, seed: int = 0) -> None:
        super().__init__(buffer, town, seed=seed)
        self.length = length

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[Any, Tensor]]:
        """Draw drives.

        Args:
            storage: unused, the segments are known.
            batch_size: frames, a multiple of ``length``.

        Returns:
            Indices ``[batch_size]``, drive by drive, and what is written into the sample.
        """
        if batch_size % self.length:
            raise ValueError(f"a batch of {batch_size} frames does not divide into drives of {self.length} frames")
        first, last, sentences = [], [], []
        for _ in range(batch_size // self.length):
            keyword, segment = self._possible()
            behind = segment.snippets[-1]
            first.append(self._decisions(segment)[0][0])
            last.append(min(int(self._snippets.start[behind]) + BEHIND, int(self._snippets.drive_end[behind])) - 1)
            sentences.append(self._passenger.say(keyword, self._random))
        steps = torch.arange(self.length)
        frames = torch.tensor(first).unsqueeze(-1) + steps
        end = torch.tensor(last).unsqueeze(-1)
        info = {
            keys.INSTRUCTION_TOKENS: self._passenger.tokenizer(sentences).repeat_interleave(self.length, 0),
            "mask": (frames <= end).flatten(),
        }
        return frames.minimum(end).flatten(), info


class OncePerFrame(Transform):
    """Draws the image of a frame once where a sample repeats it, as padding does; half the frames may be padding.

    Args:
        transforms: the camera, and what else works on its images.
    """

    def __init__(self, *transforms: Transform) -> None:
        super().__init__(in_keys=[keys.POSE, "index"], out_keys=[keys.IMAGE])
        self.transforms = Compose(*transforms)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the images of a batch from a replay buffer."""
        index = tensordict["index"].flatten()  # the sampler's mask is not yet there
        fresh = torch.ones_like(index, dtype=torch.bool)
        fresh[1:] = index[1:] != index[:-1]
        images = self.transforms(tensordict[fresh])[keys.IMAGE]
        return tensordict.set(keys.IMAGE, images[fresh.cumsum(0) - 1])
