"""The other cars of the highway-env environment: highway-env's IDM, with a right of way at junctions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from torch import Tensor

from ldrl.envs.traffic import Traffic
from ldrl.envs.vehicle import CRUISE_SPEED
from ldrl.subtasks import SubTask
from ldrl.towns import Town
from ldrl.towns.network import centre_line

__all__ = ["HighwayTraffic", "TrafficVehicle", "mark_crossings", "spawn"]

GAP = 10.0
"""Smallest distance between the centres of two cars at the start, m."""
PLAN_LANES = 3
"""Lanes of a car's route at least, so that the next one is known also after it has left one."""
CROSSING = 3.5
"""Centre lines that come closer than this cross each other; oncoming lanes are 4 m apart, m."""
STOP_BEFORE = 1.0
"""A car that gives way stops this far before the junction, m."""
ASK_BEFORE = 8.0
"""This far before the stop a car asks for its way over a junction: the second in a queue is further away, m."""
SLOW = 1.5
"""Who drives slower may not clear the junction, m/s."""


class TrafficVehicle(IDMVehicle):
    """highway-env's IDM car on an endless route: random at every junction, at most 20 km/h, never backwards.

    It crosses a junction only when nobody is on a lane that crosses its own, or has asked for one before, and when
    there is room behind the junction. The lanes are marked by :func:`mark_crossings`.
    """

    route: list[LaneIndex]
    claim: LaneIndex | None = None
    """The junction's lane that others keep clear of."""

    def follow_road(self) -> None:
        """Go on to the next lane of the route near the end of one; the route never ends."""
        self.route = self.route or [self.target_lane_index]
        while len(self.route) < PLAN_LANES:
            node, ends = self.route[-1][1], self.road.network.graph[self.route[-1][1]]
            following = [(node, end, k) for end, lanes in ends.items() for k in range(len(lanes))]
            self.route.append(following[int(self.road.np_random.integers(len(following)))])
        super().follow_road()

    def act(self, action: dict | str | None = None) -> None:
        """Steer and accelerate; brake before a junction that is not clear."""
        super().act(action)
        if self.claim is not None:
            along, _ = self.road.network.get_lane(self.claim).local_coordinates(self.position)
            if along > self.road.network.get_lane(self.claim).length + self.LENGTH / 2:
                self.claim = None
        elif not self.crashed and self.road.network.get_lane(self.route[1]).manoeuvre != SubTask.LANEFOLLOW:
            lane = self.road.network.get_lane(self.route[0])
            to_stop = lane.length - lane.local_coordinates(self.position)[0] - self.LENGTH / 2 - STOP_BEFORE
            if to_stop > ASK_BEFORE:
                return
            if self._may_cross(self.route[1]):
                self.claim = self.route[1]
            else:
                braking = -(self.speed**2) / (2 * max(to_stop, 0.1))
                self.action["acceleration"] = max(min(self.action["acceleration"], braking), -self.ACC_MAX)

    def _may_cross(self, index: LaneIndex) -> bool:
        lane = self.road.network.get_lane(index)
        for other in self.road.vehicles:
            if other is self:
                continue
            if not lane.crossing.isdisjoint(claimed(other)):
                return False
            along, lateral = lane.local_coordinates(other.position)
            if other.speed < SLOW and 0 < along < lane.length + 2.5 * self.LENGTH and abs(lateral) < CROSSING / 2:
                return False
        return True

    def lane_distance_to(self, other: RoadObject, lane: AbstractLane | None = None) -> float:
        """How far another car is ahead, m: along the lane, but not less than the straight line.

        highway-env's projection onto the lane takes a car far down a side street for one right ahead.

        Args:
            other: the other car.
            lane: to measure along; None for the car's.
        """
        along = super().lane_distance_to(other, lane)
        return math.copysign(max(abs(along), np.hypot(*(other.position - self.position))), along)

    def step(self, dt: float) -> None:
        """Move; IDM alone would back off from a car that stands too close ahead.

        Args:
            dt: time step, s.
        """
        self.action["acceleration"] = max(self.action["acceleration"], -self.speed / dt)
        super().step(dt)


def claimed(vehicle: Vehicle) -> set[LaneIndex]:
    """The lanes over a junction that a car needs; any that it can take, if it doesn't tell."""
    if isinstance(vehicle, TrafficVehicle):
        return {vehicle.claim} if vehicle.claim else set()
    start, end, _ = vehicle.lane_index
    network = vehicle.road.network
    if vehicle.lane.manoeuvre == SubTask.LANEFOLLOW:
        to_junction = vehicle.lane.length - vehicle.lane.local_coordinates(vehicle.position)[0]
        if to_junction > ASK_BEFORE + vehicle.LENGTH or vehicle.speed < SLOW:
            return set()
        start = end
    return {(start, to, k) for to, lanes in network.graph[start].items() for k in range(len(lanes))}


def mark_crossings(network: RoadNetwork) -> None:
    """Give each lane over a junction its ``crossing``: indices of the lanes from elsewhere that cross or meet it.

    Args:
        network: its lanes carry a ``manoeuvre``.
    """
    lanes = {index: lane for index, lane in network.lanes_dict().items() if lane.manoeuvre != SubTask.LANEFOLLOW}
    points = {index: centre_line(lane) for index, lane in lanes.items()}
    for lane in lanes.values():
        lane.crossing = set()
    for (a, of_a), (b, of_b) in combinations(points.items(), 2):
        if a[0] != b[0] and np.hypot(*(of_a[:, None] - of_b).transpose(2, 0, 1)).min() < CROSSING:
            lanes[a].crossing.add(b)
            lanes[b].crossing.add(a)


def spawn(road: Road, count: int, vehicle_class: type[ControlledVehicle], agent: Sequence[float]) -> None:
    """Put cars on random places of an empty road's streets, apart from each other and from the agent's car.

    Args:
        road: its lanes carry a ``manoeuvre``; its generator is used.
        count: how many cars.
        vehicle_class: of the cars.
        agent: x, y (m) and heading (rad) of the agent's car.

    Raises:
        ValueError: there is no room for so many.
    """
    rng, taken = road.np_random, np.array([agent])
    places: list[tuple[LaneIndex, AbstractLane, float]] = []
    for index, lane in road.network.lanes_dict().items():
        if lane.manoeuvre == SubTask.LANEFOLLOW:
            places += [(index, lane, s) for s in np.arange(rng.uniform(0, GAP), lane.length, GAP)]
    for k in rng.permutation(len(places)):
        if len(road.vehicles) == count:
            return
        index, lane, along = places[k]
        position, heading = lane.position(along, 0), lane.heading_at(along)
        near = np.hypot(*(taken[:, :2] - position).T) < 0.99 * GAP
        oncoming = np.cos(taken[:, 2] - heading) < -0.5
        if (oncoming | ~near).all():
            limit = min(CRUISE_SPEED, lane.speed_limit or CRUISE_SPEED)
            car = vehicle_class(road, position, heading, rng.uniform(0.7, 1.0) * limit, index, limit)
            if isinstance(car, IDMVehicle):
                car.randomize_behavior()
            road.vehicles.append(car)
            taken = np.concatenate((taken, [[*position, heading]]))
    if len(road.vehicles) < count:
        raise ValueError(f"vehicles_count={count}, but only {len(road.vehicles)} cars fit; ask for fewer")


class HighwayTraffic(Traffic):
    """highway-env's cars in the place of the :class:`~ldrl.envs.traffic.Traffic` of a TownEnv with one row.

    Args:
        town: where to drive, with a network that :func:`mark_crossings` has marked.
        count: how many cars.
        vehicle_class: of the cars.

    Attributes:
        road: where the cars are put at a reset; it moves them.
    """

    road: Road

    def __init__(self, town: Town, count: int, vehicle_class: type[ControlledVehicle]) -> None:
        self.town, self.count, self.vehicle_class = town, count, vehicle_class
        self.cars: list[Vehicle] = []

    @property
    def state(self) -> Tensor:
        """``[1, N, 4]`` float32: x, y (m), heading (rad) and speed (m/s); NaN for cars that have left the road."""
        rows = [[math.nan] * 4] * self.count
        for k, car in enumerate(self.cars):
            if car in self.road.vehicles:
                rows[k] = [*car.position.tolist(), car.heading, car.speed]
        return torch.tensor([rows], dtype=torch.float32)

    def reset(self, mask: Tensor, agent_pose: Tensor) -> None:
        """Put cars on the road, which is empty.

        Args:
            mask: not used.
            agent_pose: ``[1, 3]`` float32: x, y (m) and heading (rad).
        """
        spawn(self.road, self.count, self.vehicle_class, agent_pose[0].tolist())
        self.cars = list(self.road.vehicles)

    def right_of_way(self, route: Tensor, position: Tensor) -> Tensor:
        """Whether no car is in the way of the agent's at the next junction.

        Args:
            route: ``[1, 6]`` int64, the agent's route window.
            position: not used.

        Returns:
            ``[1]`` bool, true where the lane does not end at a junction.
        """
        _, lane, following, *_ = (self.town.lane_indices[k] for k in route[0].tolist())
        streets = [self.town.network.get_lane(index).manoeuvre == SubTask.LANEFOLLOW for index in (lane, following)]
        if streets != [True, False]:
            return torch.tensor([True])
        crossing = self.town.network.get_lane(following).crossing
        return torch.tensor([all(crossing.isdisjoint(claimed(car)) for car in self.cars)])
