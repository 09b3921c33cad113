"""The switching controller: when the high-level policy is asked (paper, Algorithm 1)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from ldrl import keys
from ldrl.modules.high_level import NO_SUBTASK
from ldrl.subtasks import SubTask

__all__ = ["VOTES", "VOTES_NEEDED", "SwitchingController"]

VOTES = 3
"""End-of-sub-task predictions that are remembered; none ends a sub-task before there are so many."""
VOTES_NEEDED = 2
"""Predictions among them that end the sub-task."""


class SwitchingController(TensorDictModuleBase):
    """Decides which cars switch, and prepares what the high-level policy then reads.

    A car switches at its first step; when two of the three latest votes say that the sub-task has ended; and when a
    new instruction is heard, at once while following a lane or finished, else when the manoeuvre under way has ended.
    A new instruction starts a new plan: no previous sub-task, and a zero decoder state.
    """

    in_keys = [  # noqa: RUF012
        keys.INSTRUCTION_TOKENS,
        keys.AGENT_SUBTASK,
        keys.VOTES,
        keys.AGE,
        keys.PLANNED_TOKENS,
        keys.HIGH_LEVEL_STATE,
    ]
    out_keys = [keys.SWITCH, keys.PREVIOUS_SUBTASK, keys.PLANNED_TOKENS, keys.HIGH_LEVEL_STATE]  # noqa: RUF012

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write who switches, and the high-level policy's inputs."""
        tokens, subtask, votes, age, planned, state = (tensordict[key] for key in self.in_keys)
        first = age == 0
        ended = (age >= VOTES) & (votes.sum(-1) >= VOTES_NEEDED) & (subtask != SubTask.FINISH)
        heard = (tokens != planned).any(-1)
        interruptible = (subtask == SubTask.LANEFOLLOW) | (subtask == SubTask.FINISH)
        switch = first | ended | (heard & interruptible)
        new_plan = switch & (first | heard)
        tensordict[keys.SWITCH] = switch
        tensordict[keys.PREVIOUS_SUBTASK] = torch.where(new_plan, NO_SUBTASK, subtask)
        tensordict[keys.PLANNED_TOKENS] = torch.where(new_plan.unsqueeze(-1), tokens, planned)
        tensordict[keys.HIGH_LEVEL_STATE] = torch.where(new_plan.unsqueeze(-1), 0.0, state)
        return tensordict
