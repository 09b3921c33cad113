"""The sub-tasks that the high-level policy chooses from (paper, section 3)."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["LOW_LEVEL", "MANOEUVRES", "SubTask"]


class SubTask(IntEnum):
    """One sub-task; its value indexes the policies' branches and logits.

    Examples:
        >>> SubTask["LEFT"].value, SubTask(4).name
        (0, 'FINISH')
    """

    LEFT = 0
    RIGHT = 1
    STRAIGHT = 2
    LANEFOLLOW = 3
    FINISH = 4


MANOEUVRES = (SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT)
"""What can be done at a junction."""
LOW_LEVEL = (*MANOEUVRES, SubTask.LANEFOLLOW)
"""The sub-tasks that a low-level policy drives: all but ``FINISH``."""
