"""Losses."""

from ldrl.objectives.imitation import ControlLoss, EndOfSubtaskLoss, SinglePolicyLoss, SubtaskLoss

__all__ = ["ControlLoss", "EndOfSubtaskLoss", "SinglePolicyLoss", "SubtaskLoss"]
