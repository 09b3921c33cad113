"""Every TensorDict key of ldrl, once.

The keys follow TorchRL's vision-language-action schema (:mod:`torchrl.data.vla`), so that its losses, validators
and dataset tools work on ldrl data unchanged. Keys under ``"world"`` are privileged: only the expert, the labels,
the camera and the metrics may read them. Keys under ``"agent"`` belong to the agent.
"""

from __future__ import annotations

from torchrl.data.vla.schema import ACTION_KEY, IMAGE_KEY, INSTRUCTION_KEY

__all__ = [
    "ACTION",
    "AGE",
    "AGENT",
    "AGENT_FINISH",
    "AGENT_SUBTASK",
    "APPEARANCE",
    "COLLISION",
    "CROSS_TRACK_ERROR",
    "END_LOGIT",
    "END_OF_SUBTASK",
    "HIGH_LEVEL_STATE",
    "IMAGE",
    "INSTRUCTION",
    "INSTRUCTION_TOKENS",
    "KEYWORD",
    "OFF_ROAD",
    "PLANNED_TOKENS",
    "POSE",
    "PREVIOUS_ACTION",
    "PREVIOUS_SUBTASK",
    "PROGRESS",
    "REMAINING",
    "RIGHT_OF_WAY",
    "ROUTE",
    "ROUTE_POSITION",
    "SAID",
    "SPEED",
    "SUBTASK",
    "SUBTASK_LOGITS",
    "SWITCH",
    "TRAFFIC",
    "VOTES",
    "WORLD",
    "WRONG_LANE",
]

ACTION = ACTION_KEY
"""Throttle in [0, 1], with traffic in [-1, 1] where negative brakes, and steer in [-1, 1] (positive turns right),
``[*B, 2]`` float32."""
IMAGE = IMAGE_KEY
"""Dash camera image, ``[*B, C, 88, 200]`` uint8."""
INSTRUCTION = INSTRUCTION_KEY
"""The passenger's sentence, text; left out on hot paths."""
INSTRUCTION_TOKENS = "instruction_tokens"
"""The sentence as vocabulary indices, ``[*B, L]`` int64, 0 is padding."""
KEYWORD = "keyword"
"""Label: what a sentence means, an index among the keywords, ``[*B]`` int64."""
SUBTASK = "subtask"
"""Label: the sub-task that the route asks for here, ``[*B]`` int64."""
END_OF_SUBTASK = "end_of_subtask"
"""Label, ``[*B]`` bool: whether the sub-task of the step before has ended; in slices for training, whether to vote for
the end of the one that the slice is told."""

WORLD = "world"
POSE = (WORLD, "pose")
"""x, y (m) and heading (rad) of the vehicle's origin, ``[*B, 3]`` float32."""
SPEED = (WORLD, "speed")
"""Speed along the heading, ``[*B, 1]`` float32, m/s."""
ROUTE = (WORLD, "route")
"""Lanes of the route around the car: the previous, the current and those ahead, ``[*B, 6]`` int16."""
ROUTE_POSITION = (WORLD, "route_position")
"""Arc length from the start of the current lane to the car's projection, ``[*B, 1]`` float32, m."""
PROGRESS = (WORLD, "progress")
"""Distance driven along the route since the reset, ``[*B, 1]`` float32, m."""
REMAINING = (WORLD, "remaining")
"""Distance left to the end of the episode's path, or to where the car must cut the throttle to stand there; infinite
when roaming, ``[*B, 1]`` float32, m."""
CROSS_TRACK_ERROR = (WORLD, "cross_track_error")
"""Signed distance from the route's centre line, positive to its right, ``[*B, 1]`` float32, m."""
OFF_ROAD = (WORLD, "off_road")
"""Whether a corner of the footprint is off the drivable surface, ``[*B, 1]`` bool."""
WRONG_LANE = (WORLD, "wrong_lane")
"""Whether two corners of the footprint are in an oncoming lane outside junctions, ``[*B, 1]`` bool."""
COLLISION = (WORLD, "collision")
"""Whether the footprint touches a building, 4 m beyond the road's edge, or another car, ``[*B, 1]`` bool."""
TRAFFIC = (WORLD, "traffic")
"""x, y (m), heading (rad) and speed (m/s) of the other cars of the same world, ``[*B, N, 4]`` float32; rows of NaN hold
no car. There is none without traffic."""
APPEARANCE = (WORLD, "appearance")
"""Number of the episode's appearance, ``[*B, 1]`` int64; only where the dash camera draws one for each episode."""
RIGHT_OF_WAY = (WORLD, "right_of_way")
"""Whether no other car is on, or can no longer stop before, a lane that excludes the route's in the next junction,
``[*B, 1]`` bool. There is none without traffic."""

AGENT = "agent"
"""The agent's own keys; it reads the root's and writes those of the next step."""
AGENT_SUBTASK = (AGENT, "subtask")
"""The sub-task under way, ``[*B]`` int64."""
PREVIOUS_SUBTASK = (AGENT, "previous_subtask")
"""The sub-task before the one to decide on, ``[*B]`` int64, 5 at an instruction's first decision."""
PREVIOUS_ACTION = (AGENT, "previous_action")
"""The action before, ``[*B, 2]`` float32, zero at an instruction's first."""
SUBTASK_LOGITS = (AGENT, "subtask_logits")
"""The high-level policy's output, ``[*B, 5]`` float32."""
SAID = (AGENT, "said")
"""What the instruction says, ``[*B, N]`` float32."""
HIGH_LEVEL_STATE = (AGENT, "high_level_state")
"""The decoder's recurrent state, ``[*B, H]`` float32."""
END_LOGIT = (AGENT, "end_logit")
"""The end-of-sub-task policy's output, ``[*B, 1]`` float32."""
VOTES = (AGENT, "votes")
"""The three latest end-of-sub-task predictions, newest last, ``[*B, 3]`` bool."""
AGE = (AGENT, "age")
"""Steps since the sub-task was chosen, ``[*B]`` int64; 0 before the first decision."""
PLANNED_TOKENS = (AGENT, "planned_tokens")
"""Tokens of the instruction that the plan is for, ``[*B, L]`` int64."""
SWITCH = (AGENT, "switch")
"""Whether the high-level policy decides at this step, ``[*B]`` bool."""
AGENT_FINISH = (AGENT, "finish")
"""Whether the agent has declared the instruction done, ``[*B]`` bool."""
