"""Imitation losses of the three networks (paper, section 4) and of the single policies; and one to learn to read."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import nn
from torch.nn import functional
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule

from ldrl import keys
from ldrl.language import KEYWORDS
from ldrl.modules import HighLevelPolicy, InstructedPolicy, LowLevelPolicy, SinglePolicy, unroll

__all__ = ["ControlLoss", "EndOfSubtaskLoss", "KeywordLoss", "SinglePolicyLoss", "SubtaskLoss"]


class _ImitationLoss(LossModule):
    """A loss that reads what a policy is shown, ``shown``, and the keys that can be set."""

    policy: TensorDictModuleBase
    policy_params: TensorDictParams
    target_policy_params: TensorDictParams

    def __init__(self, policy: TensorDictModuleBase, shown: list[NestedKey]) -> None:
        super().__init__()
        self.shown = shown
        self.convert_to_functional(policy, "policy", create_target_params=False)

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads."""
        return [*self.shown, *vars(self.tensor_keys).values()]


class _LowLevelLoss(_ImitationLoss):
    """A loss over slices of one low-level policy, which starts each slice from a zero state."""

    def __init__(self, policy: LowLevelPolicy) -> None:
        super().__init__(policy, [keys.IMAGE])
        self.state_key, self.hidden = policy.state_key, policy.hidden

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        inputs = tensordict.select(*self.shown)
        inputs[keys.AGENT_SUBTASK] = tensordict[self.tensor_keys.subtask]
        inputs[self.state_key] = torch.zeros(*tensordict.shape, self.hidden, device=inputs[keys.IMAGE].device)
        with self.policy_params.to_module(self.policy), set_recurrent_mode(True):
            return self.policy(inputs)


class ControlLoss(_LowLevelLoss):
    """L1 between the control policy's action and the expert's.

    Args:
        policy: the control policy.

    Examples:
        >>> from ldrl.modules import HierarchicalAgent
        >>> loss = ControlLoss(HierarchicalAgent().control)
        >>> data = TensorDict({"action": torch.zeros(2, 5, 2), "subtask": torch.zeros(2, 5, dtype=torch.long)}, [2, 5])
        >>> data["observation", "image"] = torch.zeros(2, 5, 1, 88, 200, dtype=torch.uint8)
        >>> loss(data)["loss_control"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = keys.ACTION
        subtask: NestedKey = keys.SUBTASK

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_control"]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: slices, batch size ``[B, T]``: image, ``subtask`` and ``action``.

        Returns:
            ``loss_control``, a scalar.
        """
        loss = functional.l1_loss(self._run(tensordict)[keys.ACTION], tensordict[self.tensor_keys.action])
        return TensorDict({"loss_control": loss})


class EndOfSubtaskLoss(_LowLevelLoss):
    """Binary cross entropy of the end-of-sub-task policy.

    Args:
        policy: the end-of-sub-task policy.
    """

    @dataclass
    class _AcceptedKeys:
        end_of_subtask: NestedKey = keys.END_OF_SUBTASK
        subtask: NestedKey = keys.SUBTASK

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_end_of_subtask", "accuracy_end_of_subtask"]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: slices, batch size ``[B, T]``: image, ``subtask`` and ``end_of_subtask``.

        Returns:
            ``loss_end_of_subtask``, a scalar, and ``accuracy_end_of_subtask``, the share of steps decided right.
        """
        logit = self._run(tensordict)[keys.END_LOGIT].squeeze(-1)
        ended = tensordict[self.tensor_keys.end_of_subtask]
        loss = functional.binary_cross_entropy_with_logits(logit, ended.float())
        accuracy = ((logit > 0) == ended).float().mean()
        return TensorDict({"loss_end_of_subtask": loss, "accuracy_end_of_subtask": accuracy})


class KeywordLoss(_ImitationLoss):
    """Cross entropy of the keyword that a sentence means, told from what a policy reads in it.

    Sentences cost much less than images, so many more of them can be learned from before the policy learns to act.

    Args:
        policy: with a ``reader``, which is trained, with a linear head that is of no use afterwards.
    """

    @dataclass
    class _AcceptedKeys:
        keyword: NestedKey = keys.KEYWORD

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_keyword", "accuracy_keyword"]  # noqa: RUF012

    def __init__(self, policy: InstructedPolicy) -> None:
        super().__init__(policy.reader, [keys.INSTRUCTION_TOKENS])
        self.hidden = policy.hidden
        device = next(policy.parameters()).device
        self.head = nn.Linear(policy.said_size, len(KEYWORDS) + 1, device=device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: sentences, any batch size: instruction tokens and ``keyword``, which is the number of keywords
                where a sentence asks for nothing.

        Returns:
            ``loss_keyword``, a scalar, and ``accuracy_keyword``, the share of sentences understood.
        """
        inputs = tensordict.select(*self.shown).flatten()
        device = inputs[keys.INSTRUCTION_TOKENS].device
        inputs[keys.HIGH_LEVEL_STATE] = torch.zeros(len(inputs), self.hidden, device=device)
        with self.policy_params.to_module(self.policy):
            logits = self.head(self.policy(inputs)[keys.SAID])
        target = tensordict[self.tensor_keys.keyword].flatten()
        loss = functional.cross_entropy(logits, target)
        accuracy = (logits.argmax(-1) == target).float().mean()
        return TensorDict({"loss_keyword": loss, "accuracy_keyword": accuracy})


class SubtaskLoss(_ImitationLoss):
    """Cross entropy of the high-level policy over sequences of decisions; padding counts for nothing.

    Args:
        policy: the high-level policy.
    """

    @dataclass
    class _AcceptedKeys:
        subtask: NestedKey = keys.SUBTASK
        mask: NestedKey = "mask"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_subtask", "accuracy_subtask"]  # noqa: RUF012

    def __init__(self, policy: HighLevelPolicy) -> None:
        super().__init__(policy, [key for key in policy.in_keys if key != keys.HIGH_LEVEL_STATE])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: sequences of decisions, batch size ``[B, D]``: image, instruction tokens,
                ``("agent", "previous_subtask")``, the right ``subtask``, and ``mask``, False for padding, which is at
                the end.

        Returns:
            ``loss_subtask``, a scalar, zero where all is padding, and ``accuracy_subtask``, the share of
            decisions made right.
        """
        mask, subtask = tensordict[self.tensor_keys.mask], self.tensor_keys.subtask
        with self.policy_params.to_module(self.policy):
            made = unroll(self.policy, tensordict.select(*self.shown, subtask), mask)
        target, logits = made[subtask], made[keys.SUBTASK_LOGITS]
        decisions = max(len(target), 1)
        loss = functional.cross_entropy(logits, target, reduction="sum") / decisions
        accuracy = (logits.argmax(-1) == target).float().sum() / decisions
        return TensorDict({"loss_subtask": loss, "accuracy_subtask": accuracy})


class SinglePolicyLoss(_ImitationLoss):
    """L1 between a single policy's action and the expert's over whole drives; padding counts for nothing.

    A policy with history is told the expert's action of the step before.

    Args:
        policy: the single policy.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = keys.ACTION
        mask: NestedKey = "mask"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_action"]  # noqa: RUF012

    def __init__(self, policy: SinglePolicy) -> None:
        super().__init__(policy, [keys.IMAGE, keys.INSTRUCTION_TOKENS])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss.

        Args:
            tensordict: drives, batch size ``[B, T]``: image, instruction tokens, the expert's ``action``, and ``mask``,
                False for padding, which is at the end.

        Returns:
            ``loss_action``, a scalar, zero where all is padding.
        """
        target = tensordict[self.tensor_keys.action]
        inputs = tensordict.select(*self.shown)
        inputs["target"] = target
        inputs[keys.PREVIOUS_ACTION] = functional.pad(target[:, :-1], (0, 0, 1, 0))
        with self.policy_params.to_module(self.policy):
            made = unroll(self.policy, inputs, tensordict[self.tensor_keys.mask])
        gap = (made[keys.ACTION] - made["target"]).abs()
        return TensorDict({"loss_action": gap.sum() / max(gap.numel(), 1)})
