"""The roaming expert: follows its route at 20 km/h."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ldrl import keys
from ldrl.envs import vehicle
from ldrl.towns import Town

__all__ = ["Expert", "expert_action"]

SPEED_GAIN = 0.15 * 3.6
"""K_P of the longitudinal controller: 0.15 per km/h (paper's expert), s/m."""
LOOK_AHEAD = 3.0
"""The lateral controller steers for the point of the route this far ahead, m."""
RESTING_THROTTLE = vehicle.ROLLING_RESISTANCE / vehicle.MAX_ACCELERATION
"""Throttle that holds a speed."""


def expert_action(town: Town, pose: Tensor, speed: Tensor, route: Tensor, position: Tensor) -> Tensor:
    """The expert's action at any state, also one that it would not have come to.

    Both controllers are proportional and without memory, so a label for a shifted camera or a disturbed car is exact:
    the car model has no bias that an integral term would have to learn. Lateral: exact pure pursuit
    (:func:`~ldrl.envs.vehicle.steer_towards`). Longitudinal: resting throttle plus 0.15 per km/h too slow.

    Args:
        town: the town.
        pose: ``[*B, 3]`` float32: x, y (m), heading (rad).
        speed: ``[*B]`` float32, m/s.
        route: ``[*B, 6]`` integer, route windows.
        position: ``[*B]`` float32, route positions within 4 m of the pose's own, m.

    Returns:
        ``[*B, 2]`` float32: throttle in [0, 1] and steer in [-1, 1].
    """
    along, _, _ = town.project(route, pose[..., :2], position)
    target, _ = town.sample(route, (along + LOOK_AHEAD).unsqueeze(-1))
    offset = target.squeeze(-2) - pose[..., :2]
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    forward = offset[..., 0] * cos + offset[..., 1] * sin
    right = offset[..., 1] * cos - offset[..., 0] * sin
    throttle = (RESTING_THROTTLE + SPEED_GAIN * (vehicle.CRUISE_SPEED - speed)).clamp(0, 1)
    return torch.stack((throttle, vehicle.steer_towards(forward, right)), -1)


class Expert(TensorDictModuleBase):
    """The expert as a policy; reads ``("world", ...)``, which no trained policy may.

    At the end of an episode's path it declares ``("agent", "finish")`` and rolls to a stop.

    Args:
        town: the town that the cars drive in.

    Examples:
        >>> from ldrl.envs import TownEnv
        >>> town = Town.load("town1")
        >>> env = TownEnv(town, num_cars=2, seed=0)
        >>> rollout = env.rollout(20, Expert(town), break_when_any_done=False)
        >>> bool(rollout["next", "world", "off_road"].any())
        False
    """

    in_keys = [keys.POSE, keys.SPEED, keys.ROUTE, keys.ROUTE_POSITION, keys.REMAINING]  # noqa: RUF012
    out_keys = [keys.ACTION, keys.AGENT_FINISH]  # noqa: RUF012

    def __init__(self, town: Town) -> None:
        super().__init__()
        self.town = town

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        pose, speed, route, position, remaining = (tensordict[key] for key in self.in_keys)
        throttle, steer = expert_action(self.town, pose, speed.squeeze(-1), route, position.squeeze(-1)).unbind(-1)
        finish = remaining.squeeze(-1) <= 0
        tensordict[keys.ACTION] = torch.stack((throttle * ~finish, steer), -1)
        tensordict[keys.AGENT_FINISH] = finish
        return tensordict
