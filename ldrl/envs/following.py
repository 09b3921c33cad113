"""Car following: highway-env's Intelligent Driver Model, and who drives ahead."""

from __future__ import annotations

import math

import torch
from highway_env.vehicle.behavior import IDMVehicle
from torch import Tensor

from ldrl.envs import vehicle
from ldrl.towns import Town

__all__ = ["JAM_DISTANCE", "PATH_SPACING", "distance_on_path", "distance_on_route", "idm_acceleration"]

JAM_DISTANCE = IDMVehicle.DISTANCE_WANTED
"""From centre to centre of standing cars, m."""
PATH_SPACING = 2.0
"""Distance between the points of a path, m."""
SIDE_GAP = 0.3
"""What comes closer than this to the sides of a car on its path is in its way, m."""


def idm_acceleration(speed: Tensor, desired: Tensor | float, gap: Tensor, leader_speed: Tensor) -> Tensor:
    """The acceleration of highway-env's ``IDMVehicle``, its parameters and clipping included.

    ``3 (1 - (v / v0)^4) - 3 (s* / gap)^2`` with the gap wanted ``s* = 10 + 1.5 v + v (v - v_leader) / (2 sqrt(15))``,
    clipped to 6 m/s^2. Treiber, Hennecke and Helbing, "Congested traffic states in empirical observations and
    microscopic simulations", 2000.

    Args:
        speed: ``[*B]``, m/s.
        desired: ``[*B]`` or a number, the speed on a free road, m/s.
        gap: ``[*B]``, to the leader from centre to centre, infinite where there is none, m.
        leader_speed: ``[*B]``, along the follower's heading, m/s.

    Returns:
        ``[*B]``, m/s^2.

    Examples:
        >>> idm_acceleration(torch.tensor([0.0, 5.0]), 5.0, torch.tensor([torch.inf, 25.0]), torch.tensor([0.0, 5.0]))
        tensor([ 3.0000, -1.4700])
    """
    comfort = IDMVehicle.COMFORT_ACC_MAX
    braking_time = 2 * math.sqrt(-comfort * IDMVehicle.COMFORT_ACC_MIN)
    wanted = JAM_DISTANCE + speed * IDMVehicle.TIME_WANTED + speed * (speed - leader_speed) / braking_time
    free = 1 - (speed.clamp(min=0) / desired) ** IDMVehicle.DELTA
    return (comfort * (free - (wanted / gap) ** 2)).clamp(-IDMVehicle.ACC_MAX, IDMVehicle.ACC_MAX)


def distance_on_route(town: Town, route: Tensor, position: Tensor) -> Tensor:
    """How far ahead on each car's route the others are.

    A car that has turned off at the junction entry before counts as if it had not: its tail may still be in the way.

    Args:
        town: the town.
        route: ``[*B, N, 6]`` int64, route windows.
        position: ``[*B, N]`` float32, route positions, m.

    Returns:
        ``[*B, N, N]`` float32: from the first car on to the second, infinite where that is not ahead, m.
    """
    fan = town.lane_successors.amin(-1)[town.lane_predecessor]  # one name for the lanes that fan out from a lane
    lanes = fan[route[..., 1:]]
    length = town.lane_length[route[..., 1:]]
    start = length.cumsum(-1) - length - position.unsqueeze(-1)
    distance = start.unsqueeze(-2) + position.unsqueeze(-2).unsqueeze(-1)
    ahead = (lanes.unsqueeze(-2) == lanes[..., 0].unsqueeze(-2).unsqueeze(-1)) & (distance > 0)
    return distance.masked_fill(~ahead, math.inf).amin(-1)


def distance_on_path(path: Tensor, others: Tensor) -> Tensor:
    """How far ahead other cars stand in the way of a car that follows a path, wherever they come from.

    Args:
        path: ``[*B, K, 3]`` float32: x, y (m) and heading (rad) of points 2 m apart, the car's own place first.
        others: ``[*B, N, 3]`` float32, poses; NaN where there is no car.

    Returns:
        ``[*B, N]`` float32, along the path from centre to centre, infinite for cars that are not in the way, m.

    Examples:
        >>> path = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
        >>> distance_on_path(path, torch.tensor([[3.5, 2.0, 0.0], [3.5, 3.0, 0.0], [3.5, 3.0, 1.57]]))
        tensor([3.5000,    inf, 3.5000])
    """
    path = path.unsqueeze(-3)  # [*B, 1, K, 3]
    x, y, heading = (others.unsqueeze(-2) - path).unbind(-1)  # [*B, N, K]
    cos, sin = path[..., 2].cos(), path[..., 2].sin()
    forward, right = x * cos + y * sin, y * cos - x * sin
    reach = (vehicle.LENGTH * heading.sin().abs() + vehicle.WIDTH * (heading.cos().abs() + 1)) / 2
    distance = torch.arange(path.shape[-2], device=path.device) * PATH_SPACING + forward
    # The points' neighbourhoods overlap, so that none is missed on the outside of a curve.
    in_the_way = (forward.abs() < 0.75 * PATH_SPACING) & (right.abs() < reach + SIDE_GAP) & (distance > 0)
    return distance.masked_fill(~in_the_way, math.inf).amin(-1)
