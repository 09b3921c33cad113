"""The high-level policy: the next sub-task from the image, the instruction and what was done before."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from ldrl import keys
from ldrl.modules.attention import GatedAttention, LuongAttention
from ldrl.modules.encoders import ImageEncoder, InstructionEncoder
from ldrl.subtasks import SubTask

__all__ = ["NO_SUBTASK", "HighLevelPolicy", "HistoryDecoder"]

NO_SUBTASK = len(SubTask)
"""The previous sub-task of an instruction's first decision."""


class HistoryDecoder(nn.Module):
    """Gated image features and the previous sub-task through a linear layer with ELU, a GRU and a linear head.

    Args:
        inputs: size of the flattened image features.
        features: size of the linear layer.
        embedding: size of the previous sub-task's embedding.
        hidden: size of the GRU's state.
    """

    def __init__(self, inputs: int, features: int, embedding: int, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Sequential(nn.Flatten(-3), nn.Linear(inputs, features), nn.ELU())
        self.embedding = nn.Embedding(len(SubTask) + 1, embedding)
        self.gru = nn.GRUCell(features + embedding, hidden)
        self.head = nn.Linear(hidden, len(SubTask))

    def forward(self, image: Tensor, previous: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Decide once.

        Args:
            image: gated features, ``[B, C, H, W]`` float32.
            previous: the sub-task before, ``[B]`` int64, ``NO_SUBTASK`` at an instruction's first decision.
            state: ``[B, H]`` float32, zero at an instruction's first decision.

        Returns:
            Logits over the sub-tasks, ``[B, 5]``, and the next state, ``[B, H]``, float32.
        """
        state = self.gru(torch.cat((self.linear(image), self.embedding(previous)), -1), state)
        return self.head(state), state


class HighLevelPolicy(TensorDictSequential):
    """The paper's full high-level policy (section 3.1), a chain of modules that can be swapped one by one.

    Instruction encoder, Luong attention asked by the decoder's state, image encoder, gated attention, decoder with
    sub-task history. It writes logits over the five sub-tasks and the decoder's next state.

    Args:
        encoder: of the images.
        channels: of the encoder's last convolution.
        instruction: size of the instruction's GRU.
        features: size of the linear layer.
        embedding: size of the previous sub-task's embedding.
        hidden: size of the decoder's GRU.
    """

    def __init__(
        self, *, encoder: ImageEncoder, channels: int, instruction: int, features: int, embedding: int, hidden: int
    ) -> None:
        self.hidden = hidden
        words, is_word, said, image, gated = (
            (keys.AGENT, part) for part in ("words", "is_word", "said", "image", "gated")
        )
        super().__init__(
            TensorDictModule(InstructionEncoder(instruction), [keys.INSTRUCTION_TOKENS], [words, is_word]),
            TensorDictModule(LuongAttention(instruction, hidden), [words, is_word, keys.HIGH_LEVEL_STATE], [said]),
            TensorDictModule(encoder, [keys.IMAGE], [image]),
            TensorDictModule(GatedAttention(instruction, channels), [image, said], [gated]),
            TensorDictModule(
                HistoryDecoder(encoder.out_features, features, embedding, hidden),
                [gated, keys.PREVIOUS_SUBTASK, keys.HIGH_LEVEL_STATE],
                [keys.SUBTASK_LOGITS, ("next", *keys.HIGH_LEVEL_STATE)],
            ),
            selected_out_keys=[keys.SUBTASK_LOGITS, ("next", *keys.HIGH_LEVEL_STATE)],
        )
