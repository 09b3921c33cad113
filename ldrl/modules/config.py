"""What an agent is made of: the paper's models as choices of the same parts, and their sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["MODELS", "AgentConfig", "Parts"]

CHANNELS = {"gs": 1, "ps": 1, "rgb": 3}
"""Channels of the image by modality."""


@dataclass(frozen=True)
class Parts:
    """Which parts a model has; the defaults are those of the paper's full model, Hih.

    Args:
        hierarchical: sub-tasks between instruction and action; else one network acts at every step.
        image: whether the network that reads the instruction sees the image.
        history: whether it is told what it chose before.
        attention: Luong's over the words and the gate over the image; else the instruction's last state is
            concatenated with the image.
        branched: one low-level GRU per sub-task; else a single one behind a gate that the sub-task sets.
    """

    hierarchical: bool = True
    image: bool = True
    history: bool = True
    attention: bool = True
    branched: bool = True


MODELS = {
    "h0": Parts(image=False, history=False),
    "hi": Parts(history=False),
    "hih": Parts(),
    "hihg": Parts(branched=False),
    "nmc": Parts(attention=False),
    "single": Parts(hierarchical=False, history=False),
    "single-history": Parts(hierarchical=False),
}
"""The models of the paper's table 3."""


@dataclass(frozen=True)
class AgentConfig:
    """An agent; the default sizes are small enough for two CPU cores, :meth:`paper` gives the paper's.

    Args:
        model: one of ``MODELS``.
        modality: what the agent sees: ``"gs"``, ``"ps"`` (one channel) or ``"rgb"``.
        image_rows: how many rows of the image the encoders see, from the bottom up.
        conv_channels: of each image encoder's convolutions.
        features: size of each linear layer behind an image encoder.
        low_level_hidden: size of a low-level GRU; there are four in each of the two networks, in ``hihg`` one.
        instruction_hidden: size of the instruction's vectors, an even number.
        subtask_embedding: size of a sub-task's embedding, or of the previous action's.
        high_level_hidden: size of the high-level GRU, or of the single policy's.

    Raises:
        ValueError: a size is no whole number above 0, ``instruction_hidden`` is odd, or the model or the modality is
            unknown.
    """

    model: str = "hih"
    modality: str = "gs"
    image_rows: int = 48
    conv_channels: tuple[int, int, int] = (16, 32, 64)
    features: int = 128
    low_level_hidden: int = 64
    instruction_hidden: int = 384
    subtask_embedding: int = 16
    high_level_hidden: int = 128

    def __post_init__(self) -> None:
        sizes = dict(vars(self))
        for name, known in (("model", MODELS), ("modality", CHANNELS)):
            if sizes.pop(name) not in known:
                raise ValueError(f"{name} is {getattr(self, name)!r}; use one of {', '.join(known)}")
        convolutions = sizes.pop("conv_channels")
        if not isinstance(convolutions, Sequence) or len(convolutions) != 3:
            raise ValueError(f"conv_channels is {convolutions!r}; give three sizes, one for each convolution")
        for name, value in (*sizes.items(), *(("conv_channels", value) for value in convolutions)):
            if type(value) is not int or value < 1:
                raise ValueError(f"{name} is {value!r}; give a whole number above 0")
        if self.instruction_hidden % 2:
            raise ValueError(f"instruction_hidden is {self.instruction_hidden}; give an even number, half for each way")
        object.__setattr__(self, "conv_channels", tuple(convolutions))

    @classmethod
    def paper(cls) -> AgentConfig:
        """The full model in the sizes of the paper's implementation."""
        return cls(
            image_rows=88,
            conv_channels=(256, 64, 64),
            features=256,
            low_level_hidden=256,
            instruction_hidden=32,
            subtask_embedding=64,
            high_level_hidden=256,
        )

    @property
    def parts(self) -> Parts:
        """Which parts the model has."""
        return MODELS[self.model]

    @property
    def image_channels(self) -> int:
        """Channels of the image."""
        return CHANNELS[self.modality]
