"""The roaming expert: follows its route at 20 km/h and gives way to other cars."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ldrl import keys
from ldrl.envs import vehicle
from ldrl.envs.following import PATH_SPACING, distance_on_path, idm_acceleration
from ldrl.envs.junctions import distance_to_entry, distance_to_stop_line
from ldrl.towns import Town

__all__ = ["Expert", "expert_action"]

SPEED_GAIN = 0.15 * 3.6
"""K_P of the longitudinal controller: 0.15 per km/h (paper's expert), s/m."""
LOOK_AHEAD = 3.0
"""The lateral controller steers for the point of the route this far ahead, m."""
SIGHT = 40.0
"""The expert brakes for cars on this much of its route ahead, m."""
RESTING_THROTTLE = vehicle.ROLLING_RESISTANCE / vehicle.MAX_ACCELERATION
"""Throttle that holds a speed."""


def expert_action(
    town: Town,
    pose: Tensor,
    speed: Tensor,
    route: Tensor,
    position: Tensor,
    traffic: Tensor | None = None,
    right_of_way: Tensor | None = None,
) -> Tensor:
    """The expert's action at any state, also one that it would not have come to.

    Both controllers are proportional and without memory, so a label for a shifted camera or a disturbed car is exact:
    the car model has no bias that an integral term would have to learn. Lateral: exact pure pursuit
    (:func:`~ldrl.envs.vehicle.steer_towards`). Longitudinal: resting throttle plus 0.15 per km/h too slow;
    with traffic highway-env's Intelligent Driver Model instead, behind the car that is in the way and, without right
    of way, the stop line (:mod:`ldrl.envs.following`, :mod:`ldrl.envs.junctions`).

    Args:
        town: the town.
        pose: ``[*B, 3]`` float32: x, y (m), heading (rad).
        speed: ``[*B]`` float32, m/s.
        route: ``[*B, 6]`` integer, route windows.
        position: ``[*B]`` float32, route positions within 4 m of the pose's own, m.
        traffic: ``[*B, N, 4]`` float32, the other cars: x, y (m), heading (rad), speed (m/s); NaN where there is none.
        right_of_way: ``[*B]`` bool, see :data:`ldrl.keys.RIGHT_OF_WAY`; given with traffic.

    Returns:
        ``[*B, 2]`` float32: throttle in [0, 1], with traffic in [-1, 1], and steer in [-1, 1].

    Raises:
        ValueError: only one of ``traffic`` and ``right_of_way`` is given.
    """
    if (traffic is None) != (right_of_way is None):
        missing = "traffic" if traffic is None else "right_of_way"
        raise ValueError(f"expert_action without {missing}: give traffic and right_of_way together, or neither")
    along, _, _ = town.project(route, pose[..., :2], position)
    target, _ = town.sample(route, (along + LOOK_AHEAD).unsqueeze(-1))
    offset = target.squeeze(-2) - pose[..., :2]
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    forward = offset[..., 0] * cos + offset[..., 1] * sin
    right = offset[..., 1] * cos - offset[..., 0] * sin
    if traffic is None or right_of_way is None:
        throttle = (RESTING_THROTTLE + SPEED_GAIN * (vehicle.CRUISE_SPEED - speed)).clamp(0, 1)
    else:
        acceleration = _give_way(town, pose, speed, route, along, traffic, right_of_way)
        throttle = vehicle.throttle_for(acceleration, speed)
    return torch.stack((throttle, vehicle.steer_towards(forward, right)), -1)


def _give_way(
    town: Town, pose: Tensor, speed: Tensor, route: Tensor, along: Tensor, traffic: Tensor, right_of_way: Tensor
) -> Tensor:
    """The acceleration behind the next car on the route and before a junction that others have, ``[*B]``."""
    steps = torch.arange(0, SIGHT + PATH_SPACING, PATH_SPACING, device=pose.device)
    points, headings = town.sample(route, along.unsqueeze(-1) + steps)
    gap, leader = distance_on_path(torch.cat((points, headings.unsqueeze(-1)), -1), traffic[..., :3]).min(-1)
    _, _, heading, leader_speed = traffic.take_along_dim(leader[..., None, None], -2).squeeze(-2).unbind(-1)
    leader_speed = (leader_speed * (heading - pose[..., 2]).cos()).masked_fill(gap.isinf(), 0)
    line = distance_to_stop_line(distance_to_entry(town, route, along), right_of_way)
    gaps, speeds = torch.stack((gap, line), -1), torch.stack((leader_speed, torch.zeros_like(line)), -1)
    return idm_acceleration(speed.unsqueeze(-1), vehicle.CRUISE_SPEED, gaps, speeds).amin(-1)


class Expert(TensorDictModuleBase):
    """The expert as a policy; reads ``("world", ...)``, which no trained policy may.

    At the end of an episode's path, or in time to stand there where it should, it declares ``("agent", "finish")`` and
    rolls to a stop. Where there is traffic it reads that and the right of way, too.

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
        others: tuple[Tensor, ...] = ()
        if keys.TRAFFIC in tensordict.keys(True):
            others = tensordict[keys.TRAFFIC], tensordict[keys.RIGHT_OF_WAY].squeeze(-1)
        action = expert_action(self.town, pose, speed.squeeze(-1), route, position.squeeze(-1), *others)
        throttle, steer = action.unbind(-1)
        finish = remaining.squeeze(-1) <= 0
        tensordict[keys.ACTION] = torch.stack((torch.where(finish, throttle.clamp(max=0), throttle), steer), -1)
        tensordict[keys.AGENT_FINISH] = finish
        return tensordict
