"""Low-level policies: one network steers and gives gas, another reports the end of the sub-task."""

from __future__ import annotations

from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import recurrent_mode

from ldrl import keys
from ldrl.modules.attention import GatedAttention
from ldrl.modules.encoders import ImageEncoder
from ldrl.subtasks import LOW_LEVEL, SubTask

__all__ = ["BranchedGRU", "LowLevelPolicy", "SubtaskGate"]


class BranchedGRU(nn.Module):
    """One GRU per sub-task, chosen by the sub-task.

    Under :class:`torchrl.modules.set_recurrent_mode` the inputs carry a time dimension after the batch's and are run
    as sequences; else each call is one step.

    Args:
        inputs: size of an input.
        hidden: size of the state.
        branches: how many; a sub-task beyond the last takes the last, so 1 is a GRU for all.
    """

    def __init__(self, inputs: int, hidden: int, branches: int = len(LOW_LEVEL)) -> None:
        super().__init__()
        self.branches = nn.ModuleList(nn.GRU(inputs, hidden, batch_first=True) for _ in range(branches))

    def forward(self, features: Tensor, subtask: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run the branches.

        Args:
            features: ``[B, (T,) F]`` float32.
            subtask: ``[B, (T)]`` int64, the same along time; ``FINISH`` takes the branch of ``LANEFOLLOW``.
            state: ``[B, (T,) H]`` float32; of a sequence the first counts.

        Returns:
            Outputs and states after each step, both ``[B, (T,) H]`` float32.
        """
        sequence = recurrent_mode()
        if sequence:
            subtask, state = subtask[:, 0], state[:, 0]
        else:
            features = features.unsqueeze(1)
        out = features.new_empty(*features.shape[:2], state.shape[-1])
        branch = subtask.clamp(max=len(self.branches) - 1)
        for index, gru in enumerate(self.branches):
            rows = (branch == index).nonzero().squeeze(-1)
            if len(rows):
                out[rows] = gru(features[rows], state[rows].unsqueeze(0))[0].to(out.dtype)
        if not sequence:
            out = out.squeeze(1)
        return out, out


class SubtaskGate(nn.Module):
    """Gates the image features by the sub-task's embedding (paper, Hihg).

    Args:
        embedding: size of the embedding.
        channels: channels of the image features.
    """

    def __init__(self, embedding: int, channels: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(len(LOW_LEVEL), embedding)
        self.attention = GatedAttention(embedding, channels)

    def forward(self, features: Tensor, subtask: Tensor) -> Tensor:
        """Gate features.

        Args:
            features: ``[*B, C, H, W]`` float32.
            subtask: ``[*B]`` int64; ``FINISH`` is seen as ``LANEFOLLOW``.

        Returns:
            ``[*B, C, H, W]`` float32.
        """
        return self.attention(features, self.embedding(subtask.clamp(max=SubTask.LANEFOLLOW)))


class LowLevelPolicy(TensorDictSequential):
    """Image to convolutions, a linear layer with ELU, one GRU per sub-task, and a linear head (paper, section 3.2).

    With a gate, the sub-task acts on the convolutions' features and one GRU serves all.

    Args:
        name: of the network; its state and features are ``("agent", name, ...)``.
        out_key: where the head writes.
        outputs: size of the head.
        encoder: of the images.
        features: size of the linear layer.
        hidden: size of each GRU.
        gate: acts on the encoder's features; None for one GRU per sub-task.
    """

    def __init__(
        self,
        name: str,
        out_key: NestedKey,
        outputs: int,
        *,
        encoder: ImageEncoder,
        features: int,
        hidden: int,
        gate: SubtaskGate | None = None,
    ) -> None:
        self.hidden = hidden
        self.state_key = (keys.AGENT, f"{name}_state")
        image, gated, encoded, decoded = (
            (keys.AGENT, f"{name}_{part}") for part in ("image", "gated", "features", "decoded")
        )
        linear = nn.Sequential(nn.Flatten(-3), nn.Linear(encoder.out_features, features), nn.ELU())
        chain = [TensorDictModule(encoder, [keys.IMAGE], [image])]
        if gate is not None:
            chain.append(TensorDictModule(gate, [image, keys.AGENT_SUBTASK], [gated]))
        chain += [
            TensorDictModule(linear, chain[-1].out_keys, [encoded]),
            TensorDictModule(
                BranchedGRU(features, hidden, len(LOW_LEVEL) if gate is None else 1),
                [encoded, keys.AGENT_SUBTASK, self.state_key],
                [decoded, ("next", *self.state_key)],
            ),
            TensorDictModule(nn.Linear(hidden, outputs), [decoded], [out_key]),
        ]
        super().__init__(*chain, selected_out_keys=[out_key, ("next", *self.state_key)])
