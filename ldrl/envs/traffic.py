"""Traffic: the other cars of every world."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ldrl.envs import vehicle
from ldrl.envs.following import PATH_SPACING, distance_on_path, distance_on_route, idm_acceleration
from ldrl.envs.junctions import CLAIM_DISTANCE, Junctions, distance_to_entry, distance_to_stop_line
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES, Town

__all__ = ["Agent", "Traffic", "random_turn"]

DESIRED_SPEED = (0.8 * vehicle.CRUISE_SPEED, vehicle.CRUISE_SPEED)
"""Drawn for each car; the upper end is the towns' speed limit, to which highway-env clips it, m/s."""
SPAWN_SPACING = 20.0
"""Places to start at are this far apart, and half as far from junctions, m."""
SPAWN_JITTER = 2.0
"""A car starts up to this far from its place, m."""
SPAWN_DISTANCE = 20.0
"""Nobody starts closer to the agent, m."""
LOOK_AHEAD = 40.0
"""Cars see the agent's car on this much of their way, m."""
MOVING_SPEED = 0.1
"""Below it the agent's car stands, and gives its right of way up, m/s."""


def random_turn(town: Town, lane: Tensor, generator: torch.Generator) -> Tensor:
    """One of the lanes that follow each lane, at random.

    Args:
        town: the town.
        lane: ``[*B]`` int64.
        generator: what draws.

    Returns:
        ``[*B]`` int64.
    """
    count = town.lane_successor_count[lane]
    chosen = (torch.rand(lane.shape, generator=generator, device=lane.device) * count).long().minimum(count - 1)
    return town.lane_successors[lane].gather(-1, chosen.unsqueeze(-1)).squeeze(-1)


class Agent(NamedTuple):
    """What the others know of the agent's car: its place, and the lane that it should be on."""

    pose: Tensor
    """``[W, 3]`` float32: x, y (m) and heading (rad)."""
    speed: Tensor
    """``[W]`` float32, m/s."""
    route: Tensor
    """``[W, 6]`` int64, route window."""
    position: Tensor
    """``[W]`` float32, route position, m."""


class Traffic:
    """The same number of other cars in each of many worlds, all moved at once.

    The cars follow the centres of their lanes exactly, turn at random at junctions and follow one another, and the
    agent's car, by highway-env's Intelligent Driver Model; :class:`~ldrl.envs.junctions.Junctions` says who may enter
    a junction, and who may not brakes as for a car that stands behind the stop line.

    Args:
        town: where to drive.
        worlds: how many.
        cars: how many in each.
        generator: what draws starts, desired speeds and turns.
        agent_starts: ``[M, 2]`` float32, where the agent's car may start, m.

    Raises:
        ValueError: ``cars`` is no number of cars, or the town's streets have no room for as many.
    """

    def __init__(self, town: Town, worlds: int, cars: int, generator: torch.Generator, agent_starts: Tensor) -> None:
        if isinstance(cars, bool) or not isinstance(cars, int) or cars < 0:
            raise ValueError(f"traffic={cars!r}: give the number of other cars, an int of 0 or more")
        self.town, self._generator, self._shape = town, generator, (worlds, cars)
        self._junctions = Junctions(town)
        self._places = self._find_places()
        capacity = self._capacity(agent_starts)
        if cars > capacity:
            raise ValueError(
                f"traffic={cars}: the streets of {town.name!r} have room for {capacity} other cars; use fewer"
            )
        self._route = torch.zeros(worlds, cars, ROUTE_LANES, dtype=torch.long, device=town.points.device)
        self._position = torch.zeros(worlds, cars, device=town.points.device)
        self._speed = torch.zeros_like(self._position)
        self._desired = torch.ones_like(self._position)
        self._may_enter = torch.zeros_like(self._position, dtype=torch.bool)
        self._waited = torch.zeros_like(self._position, dtype=torch.long)
        self._path = self._look_ahead()

    def _find_places(self) -> tuple[Tensor, Tensor, Tensor]:
        """Lane, route position and point of every place to start at."""
        street = self.town.lane_manoeuvre == SubTask.LANEFOLLOW
        count = (self.town.lane_length / SPAWN_SPACING).long() * street
        lane = torch.repeat_interleave(count)
        k = torch.arange(len(lane), device=lane.device) - (count.cumsum(0) - count)[lane]
        position = (k + 0.5) * self.town.lane_length[lane] / count[lane]
        point, _ = self.town.sample(lane.unsqueeze(-1).expand(-1, ROUTE_LANES), position.unsqueeze(-1))
        return lane, position, point.squeeze(1)

    def _capacity(self, agent_starts: Tensor) -> int:
        """Places that are free wherever the agent's car starts."""
        reach = SPAWN_DISTANCE + 0.5  # the starts are samples
        near = [int((torch.cdist(some, self._places[2]) < reach).sum(-1).amax()) for some in agent_starts.split(1024)]
        return len(self._places[0]) - max(near)

    @property
    def state(self) -> Tensor:
        """``[W, N, 4]`` float32: x, y (m), heading (rad) and speed (m/s)."""
        return torch.cat((self._path[:, :, 0], self._speed.unsqueeze(-1)), -1)

    def reset(self, mask: Tensor, agent_pose: Tensor) -> None:
        """Put the cars of some worlds at random places, at their desired speeds.

        Args:
            mask: ``[W]`` bool, which worlds.
            agent_pose: ``[W, 3]`` float32: x, y (m) and heading (rad).
        """
        lanes, positions, points = self._places
        score = self._uniform((self._shape[0], len(lanes)))
        near = torch.cdist(agent_pose[:, :2], points) < SPAWN_DISTANCE
        place = score.masked_fill(near, -1).topk(self._shape[1]).indices
        lane = lanes[place]
        route = [self.town.lane_predecessor[lane], lane]
        while len(route) < ROUTE_LANES:
            route.append(random_turn(self.town, route[-1], self._generator))
        low, high = DESIRED_SPEED
        desired = low + (high - low) * self._uniform(self._shape)
        jitter = SPAWN_JITTER * (2 * self._uniform(self._shape) - 1)
        rows = mask.unsqueeze(-1)
        self._route = torch.where(rows.unsqueeze(-1), torch.stack(route, -1), self._route)
        self._position = torch.where(rows, positions[place] + jitter, self._position)
        self._desired = torch.where(rows, desired, self._desired)
        self._speed = torch.where(rows, desired, self._speed)
        self._may_enter = self._may_enter & ~rows
        self._waited = self._waited * ~rows
        self._path = self._look_ahead()

    def step(self, mask: Tensor, agent: Agent) -> None:
        """Move the cars of some worlds by 0.1 s.

        Args:
            mask: ``[W]`` bool, which worlds.
            agent: the agent's cars.
        """
        ahead = distance_on_route(self.town, self._route, self._position)
        agent_ahead = distance_on_path(self._path, agent.pose[:, None, None])
        to_entry = distance_to_entry(self.town, self._route, self._position)
        may_enter, waited = self._right_of_way(agent, to_entry, torch.cat((ahead, agent_ahead), -1))
        acceleration = self._accelerate(agent, ahead, agent_ahead, distance_to_stop_line(to_entry, may_enter))
        rows = mask.unsqueeze(-1)
        self._may_enter = torch.where(rows, may_enter, self._may_enter)
        self._waited = torch.where(rows, waited, self._waited)
        position = self._position + self._speed * vehicle.TIME_STEP * rows
        speed = (self._speed + acceleration * vehicle.TIME_STEP).clamp(min=0)
        self._speed = torch.where(rows, speed, self._speed)
        self._advance(position)
        self._path = self._look_ahead()

    def right_of_way(self, route: Tensor, position: Tensor) -> Tensor:
        """Whether no car is in the way of the agent's at the next junction: on an excluding lane, or unable to stop.

        Args:
            route: ``[W, 6]`` int64, the agent's route window.
            position: ``[W]`` float32, the agent's route position, m.

        Returns:
            ``[W]`` bool, true where the lane does not end at a junction.
        """
        to_entry = distance_to_entry(self.town, self._route, self._position)
        entering = self._may_enter & self._junctions.committed(to_entry, self._speed)
        closed = self._junctions.closed(
            self._junctions.closers, route[:, 2:3], self._route, self._position, entering
        ).squeeze(-1)
        return ~closed | distance_to_entry(self.town, route, position).isinf()

    def any_ahead(self, pose: Tensor, distance: float) -> Tensor:
        """Whether there is a car in front of the agent's, to whichever side.

        Args:
            pose: ``[W, 3]`` float32, the agent's: x, y (m) and heading (rad).
            distance: how far to look, m.

        Returns:
            ``[W]`` bool.
        """
        offset = self.state[..., :2] - pose[:, None, :2]
        direction = torch.stack((pose[:, 2].cos(), pose[:, 2].sin()), -1).unsqueeze(1)
        return (((offset * direction).sum(-1) > 0) & (offset.norm(dim=-1) < distance)).any(-1)

    def _uniform(self, shape: tuple[int, int]) -> Tensor:
        return torch.rand(shape, generator=self._generator, device=self.town.points.device)

    def _right_of_way(self, agent: Agent, to_entry: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
        """Who may enter, and how long they have waited."""
        junctions = self._junctions
        entry = distance_to_entry(self.town, agent.route, agent.position)
        before = (self._route[..., 1] == agent.route[:, 1:2]) & (self._position > agent.position.unsqueeze(-1))
        drives = (agent.speed >= MOVING_SPEED) & (entry < CLAIM_DISTANCE) & ~before.any(-1)
        entering = drives | (entry < vehicle.LENGTH / 2)
        asked, at_agent = self._route[..., 2], (agent.route.unsqueeze(1), agent.position.unsqueeze(1))
        by_agent = junctions.closed(junctions.closers_any_turn, asked, *at_agent, entering.unsqueeze(1))
        stays_out = by_agent & ~junctions.committed(to_entry, self._speed)
        may_enter = self._may_enter & to_entry.isfinite() & ~stays_out
        closed = junctions.closed(junctions.closers, asked, self._route, self._position, may_enter) | by_agent
        return junctions.grant(may_enter, self._waited, self._route, to_entry, ahead, closed)

    def _accelerate(self, agent: Agent, ahead: Tensor, agent_ahead: Tensor, line: Tensor) -> Tensor:
        """Follow the nearest car, the agent's if it is in the way, and the stop line, whichever asks for most."""
        nearest, leader = ahead.min(-1)
        heading = self._path[:, :, 0, 2]
        leader_speed = self._speed.gather(-1, leader) * (heading.gather(-1, leader) - heading).cos()
        agent_speed = agent.speed.unsqueeze(-1) * (agent.pose[:, 2:] - heading).cos()
        gaps = torch.stack((nearest, agent_ahead.squeeze(-1), line), -1)
        speeds = torch.stack((leader_speed, agent_speed, torch.zeros_like(line)), -1)
        return idm_acceleration(self._speed.unsqueeze(-1), self._desired.unsqueeze(-1), gaps, speeds).amin(-1)

    def _advance(self, position: Tensor) -> None:
        """Move the route windows along with the cars."""
        length = self.town.lane_length[self._route[..., 1]]
        passed = position >= length
        self._position = torch.where(passed, position - length, position)
        following = random_turn(self.town, self._route[..., -1], self._generator)
        shifted = torch.cat((self._route[..., 1:], following.unsqueeze(-1)), -1)
        self._route = torch.where(passed.unsqueeze(-1), shifted, self._route)

    def _look_ahead(self) -> Tensor:
        """``[W, N, K, 3]``: the poses that each car will pass, its own first."""
        steps = torch.arange(0, LOOK_AHEAD + PATH_SPACING, PATH_SPACING, device=self._position.device)
        points, headings = self.town.sample(self._route, self._position.unsqueeze(-1) + steps)
        return torch.cat((points, headings.unsqueeze(-1)), -1)
