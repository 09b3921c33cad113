"""What the passenger says."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NonTensorStack, TensorDictBase
from torchrl.data import NonTensor, TensorSpec, Unbounded
from torchrl.envs import Transform

from ldrl import keys
from ldrl.language import KEYWORDS, Keyword, Sentences, Tokenizer

__all__ = ["Instruction"]


class Instruction(Transform):
    """Gives each car its instruction at reset and repeats it at every step.

    Args:
        sentences: one sentence per car, said again at each of its resets; None draws a keyword and a sentence.
        keywords: what to draw from; None for all 14.
        split: which sentences are drawn, ``"train"`` or ``"heldout"``.
        text: whether to write the sentence as ``language_instruction`` as well, which is slow.
        seed: of the transform's own generator; parallel workers need one each, for ``env.set_seed`` does not reach it.

    Raises:
        ValueError: an unknown keyword; at reset, a sentence without words or not one sentence per car.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from ldrl.envs import TownEnv
        >>> from ldrl.towns import Town
        >>> env = TransformedEnv(TownEnv(Town.load("town1"), num_cars=1), Instruction(["turn left"], text=True))
        >>> list(env.reset()["language_instruction"])
        ['turn left']
    """

    def __init__(
        self,
        sentences: Sequence[str] | None = None,
        *,
        keywords: Sequence[str] | None = None,
        split: Literal["train", "heldout"] = "train",
        text: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[keys.INSTRUCTION_TOKENS] + [keys.INSTRUCTION] * text)
        self.tokenizer = Tokenizer()
        self.keywords = [Keyword.parse(name) for name in (keywords or KEYWORDS)]
        self.fixed = None if sentences is None else list(sentences)
        self.text = text
        self._source = Sentences(split)
        self._random = random.Random(seed)
        self._said: list[str] = []
        self._tokens = torch.zeros(0, self.tokenizer.max_tokens, dtype=torch.long)

    def _draw(self) -> str:
        return self._source.sample(self._random.choice(self.keywords), self._random)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        cars = tensordict_reset.numel()
        if self.fixed is not None and len(self.fixed) != cars:
            raise ValueError(f"{len(self.fixed)} sentences for {cars} cars; give one to each")
        reset = tensordict.get("_reset", None)
        if reset is None or len(self._tokens) != cars:
            rows = torch.arange(cars)
            self._said = [""] * cars
            self._tokens = self._tokens.new_zeros(cars, self.tokenizer.max_tokens, device=tensordict_reset.device)
        else:
            rows = reset.view(-1).nonzero().squeeze(-1).cpu()
        for row in rows.tolist():
            self._said[row] = self._draw() if self.fixed is None else self.fixed[row]
        if len(rows):
            self._tokens = self._tokens.clone()
            self._tokens[rows] = self.tokenizer([self._said[row] for row in rows.tolist()]).to(self._tokens.device)
        return self._call(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch = next_tensordict.batch_size
        next_tensordict[keys.INSTRUCTION_TOKENS] = self._tokens.view(*batch, -1)
        if self.text:
            next_tensordict[keys.INSTRUCTION] = NonTensorStack(*self._said).view(batch) if batch else self._said[0]
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the instruction."""
        shape, device = observation_spec.shape, observation_spec.device
        length = self.tokenizer.max_tokens
        observation_spec[keys.INSTRUCTION_TOKENS] = Unbounded((*shape, length), device, torch.int64)
        if self.text:
            observation_spec[keys.INSTRUCTION] = NonTensor(shape, device, example_data="")
        return observation_spec
