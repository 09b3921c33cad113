"""Losses."""

from ldrl.objectives.imitation import ControlLoss, EndOfSubtaskLoss, KeywordLoss, SinglePolicyLoss, SubtaskLoss

__all__ = ["ControlLoss", "EndOfSubtaskLoss", "KeywordLoss", "SinglePolicyLoss", "SubtaskLoss"]
