"""Right of way: which lanes of a junction exclude one another, and who may enter."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ldrl.envs import vehicle
from ldrl.envs.following import JAM_DISTANCE
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES, Town

__all__ = ["CLAIM_DISTANCE", "Junctions", "distance_to_entry", "distance_to_stop_line"]

CLAIM_DISTANCE = 25.0
"""From here on a car asks for its way and, while it has none, brakes for the stop line, m before the entry."""
STOP_DISTANCE = vehicle.LENGTH / 2 + 1.0
"""From the entry back to the centre of a car at the stop line, m."""
CLEAR_DISTANCE = vehicle.LENGTH / 2 + 0.5
"""A car has left a junction when its centre is this far past the exit, m."""
SAFE_BRAKING = 2.0
"""A car that would have to brake harder than this to stay out goes in, m/s^2."""
SIDE_GAP = 0.25
"""Lanes exclude one another if cars on them come closer than twice this, m."""
SWEEP_SPACING = 1.0
"""Largest distance between the poses along a lane that stand for all, m."""


def distance_to_entry(town: Town, route: Tensor, position: Tensor) -> Tensor:
    """From cars to the junction at the end of their lane.

    Args:
        town: the town.
        route: ``[*B, 6]`` integer, route windows.
        position: ``[*B]`` float32, route positions, m.

    Returns:
        ``[*B]`` float32, infinite within junctions and where the lane does not end at one, m.
    """
    lane, ahead = route[..., 1].long(), route[..., 2].long()
    in_junction = town.lane_manoeuvre != SubTask.LANEFOLLOW
    approaching = in_junction[ahead] & ~in_junction[lane]
    return (town.lane_length[lane] - position).masked_fill(~approaching, math.inf)


def distance_to_stop_line(to_entry: Tensor, may_enter: Tensor) -> Tensor:
    """Where a car would have to stand ahead for a follower of it to stop at the stop line.

    Args:
        to_entry: ``[*B]``, see :func:`distance_to_entry`.
        may_enter: ``[*B]`` bool.

    Returns:
        ``[*B]``, infinite for cars that may enter or are far from the junction, m.
    """
    stops = ~may_enter & (to_entry < CLAIM_DISTANCE)
    return (to_entry - STOP_DISTANCE + JAM_DISTANCE).masked_fill(~stops, math.inf)


class Junctions:
    """Who may enter a junction, for many worlds at once.

    Lanes of a junction exclude one another if the footprints of cars that drive them would touch. A car closes the
    lanes that its own excludes from when it may enter until its tail is out. First come, first served: the first car
    of a queue may enter when its lane is not closed, nobody who waits longer wants a lane that excludes it, and there
    is room behind the junction, so that nobody stops in it.

    The agent's car has the right of way over all that can still stop, whichever way it will turn; it loses it when it
    stands. So neither an agent that drives on nor one that waits is in the way of the others for long.

    Args:
        town: the town.
    """

    def __init__(self, town: Town) -> None:
        self.town = town
        self.in_junction = town.lane_manoeuvre != SubTask.LANEFOLLOW
        self.exclude = _exclusions(town)
        siblings = town.lane_predecessor.unsqueeze(0) == town.lane_predecessor.unsqueeze(1)
        self.closers = _lists(self.exclude)
        self.closers_any_turn = _lists(siblings.float() @ self.exclude.float() > 0)

    def committed(self, to_entry: Tensor, speed: Tensor) -> Tensor:
        """Whether cars before a junction can no longer stop, ``[*B]`` bool."""
        return to_entry - vehicle.LENGTH / 2 < speed.square() / (2 * SAFE_BRAKING)

    def closed(self, closers: Tensor, asked: Tensor, route: Tensor, position: Tensor, entering: Tensor) -> Tensor:
        """Whether cars close lanes for others.

        Args:
            closers: ``[L, K]`` int64, the lanes on which a car closes each lane: ``closers`` or ``closers_any_turn``.
            asked: ``[W, M]`` int64, lanes.
            route: ``[W, N, 6]`` int64, route windows of the cars.
            position: ``[W, N]`` float32, their route positions, m.
            entering: ``[W, N]`` bool, those that close their next lane, too.

        Returns:
            ``[W, M]`` bool.
        """
        lanes = route[..., :3]
        inside = self.in_junction[lanes]
        leaving = inside[..., 0] & (position < CLEAR_DISTANCE)
        used = torch.stack((leaving, inside[..., 1], inside[..., 2] & entering), -1)
        occupied = torch.zeros(len(route), len(closers) + 1, device=route.device)  # the last lane is none
        occupied.scatter_add_(1, lanes.flatten(1), used.flatten(1).float())
        return (occupied.gather(1, closers[asked].flatten(1)) > 0).view(*asked.shape, -1).any(-1)

    def grant(
        self, may_enter: Tensor, waited: Tensor, route: Tensor, to_entry: Tensor, ahead: Tensor, closed: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Let cars enter.

        Args:
            may_enter: ``[W, N]`` bool, those that already may.
            waited: ``[W, N]`` int64, steps since each was the first before its junction.
            route: ``[W, N, 6]`` int64, route windows.
            to_entry: ``[W, N]`` float32, see :func:`distance_to_entry`.
            ahead: ``[W, N, M]`` float32, how far ahead on each car's route other cars are, m.
            closed: ``[W, N]`` bool, whether each car's next lane is closed.

        Returns:
            ``may_enter`` and ``waited``, one step later.
        """
        lane = route[..., 2]
        first = (to_entry < CLAIM_DISTANCE) & (ahead > to_entry.unsqueeze(-1)).all(-1)
        waited = (waited + 1) * first
        exit_ = (to_entry + self.town.lane_length[lane]).unsqueeze(-1)
        room = ahead.masked_fill(ahead < exit_, math.inf).amin(-1) - exit_.squeeze(-1)
        needed = CLEAR_DISTANCE + JAM_DISTANCE * (1 + (ahead < exit_).sum(-1))
        asks = first & ~may_enter & (room > needed)
        turn = waited * route.shape[1] - torch.arange(route.shape[1], device=route.device)
        rival = self.exclude[lane.unsqueeze(-1), lane.unsqueeze(-2)] & asks.unsqueeze(-2)
        beaten = (rival & (turn.unsqueeze(-2) > turn.unsqueeze(-1))).any(-1)
        return may_enter | (asks & ~beaten & ~closed), waited


def _lists(exclude: Tensor) -> Tensor:
    """For each lane those that exclude it, ``[L, K]`` int64, filled up with ``L``."""
    width = max(1, int(exclude.sum(0).max()))
    lanes = torch.arange(len(exclude), device=exclude.device).unsqueeze(1).where(exclude, len(exclude))
    return lanes.sort(0).values[:width].t().contiguous()


def _exclusions(town: Town) -> Tensor:
    """``[L, L]`` bool: lanes on which cars would touch, from the stop line until the tail is out of the junction."""
    lanes = (town.lane_manoeuvre != SubTask.LANEFOLLOW).nonzero().squeeze(-1)
    if not len(lanes):
        return torch.zeros(len(town.lane_length), len(town.lane_length), dtype=torch.bool, device=lanes.device)
    route = [town.lane_predecessor[lanes], lanes]
    while len(route) < ROUTE_LANES:
        route.append(town.lane_successors[route[-1], 0])
    span = town.lane_length[lanes] + STOP_DISTANCE + CLEAR_DISTANCE
    part = torch.linspace(0, 1, math.ceil(float(span.amax()) / SWEEP_SPACING) + 1, device=lanes.device)
    points, headings = town.sample(torch.stack(route, -1), part * span.unsqueeze(-1) - STOP_DISTANCE)
    poses = torch.cat((points, headings.unsqueeze(-1)), -1)
    middle = points[:, len(part) // 2]
    near = torch.cdist(middle, middle) < span.amax() + 2 * vehicle.LENGTH
    first, second = near.nonzero().unbind(-1)
    touching = vehicle.overlap(poses[first].unsqueeze(2), poses[second].unsqueeze(1), SIDE_GAP).flatten(1).any(-1)
    exclude = torch.zeros(len(town.lane_length), len(town.lane_length), dtype=torch.bool, device=lanes.device)
    exclude[lanes[first], lanes[second]] = touching
    return exclude & ~torch.eye(len(exclude), dtype=torch.bool, device=lanes.device)
