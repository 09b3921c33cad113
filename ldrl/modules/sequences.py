"""Runs an instructed policy over sequences: what does not depend on the step before runs once, for all steps."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ldrl import keys
from ldrl.modules.high_level import InstructedPolicy

__all__ = ["unroll"]


def unroll(policy: InstructedPolicy, sequences: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """Run a policy along sequences, each from a zero state.

    Modules that read nothing but the instruction run once per sequence; those that do not depend on the decoder's
    state, such as convolutions, once over all steps; only the others run step by step. It comes to the same as the
    whole chain at every step, but for the noise that the instruction encoder adds in training, drawn once per sequence.

    Args:
        policy: whatever modules are in its chain.
        sequences: batch size ``[B, T]`` with the policy's inputs but for the state; the instruction of the first step
            is that of the sequence.
        mask: ``[B, T]`` bool, False for padding, which is at the end and is left out.

    Returns:
        ``sequences[mask]`` with the policy's output, batch size ``[mask.sum()]``, in the order of the steps.
    """
    sentence, frame, recurrent = _stages(policy)
    order = mask.sum(1).argsort(descending=True)  # the rows that are still running at a step are then the first
    step, row = mask[order].t().nonzero().unbind(1)
    steps = sequences[order[row], step]
    instructions = sequences[order, 0].select(keys.INSTRUCTION_TOKENS)
    for module in sentence:
        module(instructions)
    steps.update(instructions.select(*_read(frame), strict=False)[row])
    for module in frame:
        module(steps)
    instructions = instructions.select(*_read(recurrent), strict=False)
    known = steps.select(*_read(recurrent), strict=False)
    state = torch.zeros(len(sequences), policy.hidden, device=mask.device)
    chosen = []
    for inputs in known.split([count for count in mask.sum(0).tolist() if count] or [0]):
        inputs.update(instructions[: len(inputs)])
        inputs[keys.HIGH_LEVEL_STATE] = state[: len(inputs)]
        for module in recurrent:
            module(inputs)
        state = inputs["next", *keys.HIGH_LEVEL_STATE]
        chosen.append(inputs[policy.out_key])
    steps[policy.out_key] = torch.cat(chosen)
    return steps


def _stages(policy: InstructedPolicy) -> tuple[list[TensorDictModuleBase], ...]:
    """The chain's modules: those that read the instruction only, those of one frame, and those of the state."""
    said, late = {keys.INSTRUCTION_TOKENS}, {keys.HIGH_LEVEL_STATE}
    stages: tuple[list[TensorDictModuleBase], ...] = ([], [], [])
    for module in policy.module:
        reads = set(module.in_keys)
        if reads & late:
            late.update(module.out_keys)
            stages[2].append(module)
        elif reads <= said:
            said.update(module.out_keys)
            stages[0].append(module)
        else:
            stages[1].append(module)
    return stages


def _read(modules: list[TensorDictModuleBase]) -> set:
    """Every key that some of these modules read."""
    return {key for module in modules for key in module.in_keys}
