"""Losses."""

from ldrl.objectives.imitation import ControlLoss, EndOfSubtaskLoss, SubtaskLoss

__all__ = ["ControlLoss", "EndOfSubtaskLoss", "SubtaskLoss"]
