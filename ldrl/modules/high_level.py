"""The high-level policy: the next sub-task from the image, the instruction and what was done before."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ldrl import keys
from ldrl.modules.attention import Concatenation, GatedAttention, LastWord, LuongAttention
from ldrl.modules.config import AgentConfig
from ldrl.modules.encoders import ImageEncoder, InstructionEncoder
from ldrl.subtasks import SubTask

__all__ = ["NO_SUBTASK", "Decoder", "HighLevelPolicy", "InstructedPolicy"]

NO_SUBTASK = len(SubTask)
"""The previous sub-task of an instruction's first decision."""


class Decoder(nn.Module):
    """What is known through a linear layer with ELU, the choice before through an embedding, a GRU and a linear head.

    Args:
        inputs: size of what is known, flattened.
        features: size of the linear layer.
        hidden: size of the GRU's state.
        outputs: size of the head.
        embedding: of the choice before; None where it is not told.
        embedded: size of that embedding.
    """

    def __init__(
        self,
        inputs: int,
        features: int,
        hidden: int,
        outputs: int,
        embedding: nn.Module | None = None,
        embedded: int = 0,
    ) -> None:
        super().__init__()
        self.linear = nn.Sequential(nn.Flatten(1), nn.Linear(inputs, features), nn.ELU())
        self.embedding = embedding
        self.gru = nn.GRUCell(features + embedded, hidden)
        self.head = nn.Linear(hidden, outputs)

    def forward(self, known: Tensor, state: Tensor, previous: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Choose once.

        Args:
            known: ``[B, C, H, W]`` or ``[B, F]`` float32.
            state: ``[B, H]`` float32, zero at an instruction's first choice.
            previous: the choice before, ``[B, ...]``, fit for the embedding.

        Returns:
            Outputs, ``[B, N]``, and the next state, ``[B, H]``, float32.
        """
        features = self.linear(known)
        if self.embedding is not None:
            features = torch.cat((features, self.embedding(previous)), -1)
        state = self.gru(features, state)
        return self.head(state), state


class InstructedPolicy(TensorDictSequential):
    """From instruction and image to a choice (paper, section 3.1), a chain of modules that can be swapped one by one.

    Instruction encoder, Luong attention asked by the decoder's state, image encoder, gated attention, decoder. A
    model that lacks a part has a shorter chain. It writes the choice and the decoder's next state. A call is one
    step; :func:`~ldrl.modules.unroll` runs sequences.

    Args:
        config: which parts, and their sizes.
        out_key: where the choice is written.
        outputs: its size.
        previous_key: the choice before.
        embedding: of the choice before, of size ``config.subtask_embedding``.
    """

    def __init__(
        self, config: AgentConfig, out_key: NestedKey, outputs: int, previous_key: NestedKey, embedding: nn.Module
    ) -> None:
        parts, said_size = config.parts, config.instruction_hidden
        self.said_size = said_size
        self.hidden = config.high_level_hidden
        self.out_key = out_key
        words, is_word, image, fused = ((keys.AGENT, part) for part in ("words", "is_word", "image", "fused"))
        said = keys.SAID
        chain = [TensorDictModule(InstructionEncoder(said_size), [keys.INSTRUCTION_TOKENS], [words, is_word])]
        if parts.attention:
            attention = LuongAttention(said_size, self.hidden)
            chain.append(TensorDictModule(attention, [words, is_word, keys.HIGH_LEVEL_STATE], [said]))
        else:
            chain.append(TensorDictModule(LastWord(), [words, is_word], [said]))
        known, inputs = said, said_size
        if parts.image:
            encoder = ImageEncoder(config.image_channels, config.conv_channels, config.image_rows)
            fusion = GatedAttention(said_size, config.conv_channels[-1]) if parts.attention else Concatenation()
            chain.append(TensorDictModule(encoder, [keys.IMAGE], [image]))
            chain.append(TensorDictModule(fusion, [image, said], [fused]))
            known, inputs = fused, encoder.out_features + (0 if parts.attention else said_size)
        told = [previous_key] if parts.history else []
        history = (embedding, config.subtask_embedding) if parts.history else ()
        chain.append(
            TensorDictModule(
                Decoder(inputs, config.features, self.hidden, outputs, *history),
                [known, keys.HIGH_LEVEL_STATE, *told],
                [out_key, ("next", *keys.HIGH_LEVEL_STATE)],
            )
        )
        super().__init__(*chain, selected_out_keys=[out_key, ("next", *keys.HIGH_LEVEL_STATE)])

    @property
    def reader(self) -> TensorDictSequential:
        """The part that turns the instruction into one vector, ``("agent", "said")``: the first two modules."""
        return TensorDictSequential(*self.module[:2])


class HighLevelPolicy(InstructedPolicy):
    """Writes logits over the five sub-tasks; the choice before is the previous sub-task.

    Args:
        config: which parts, and their sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        embedding = nn.Embedding(NO_SUBTASK + 1, config.subtask_embedding)
        super().__init__(config, keys.SUBTASK_LOGITS, len(SubTask), keys.PREVIOUS_SUBTASK, embedding)
