"""highway-env's road and traffic for towns: fast, and with a right of way at junctions."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ldrl.envs.vehicle import CRUISE_SPEED
from ldrl.subtasks import SubTask
from ldrl.towns.network import IndexedNetwork, centre_line

__all__ = ["IndexedRoad", "TrafficVehicle", "mark_crossings", "spawn"]

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


class IndexedRoad(Road):
    """A :class:`~highway_env.road.road.Road` that looks only at cars which are close enough to matter.

    Its network is an :class:`IndexedNetwork`. What cars do is the same.
    """

    network: IndexedNetwork

    def step(self, dt: float) -> None:
        """Move the cars, then let those collide that touch.

        Args:
            dt: time step, s.
        """
        for vehicle in self.vehicles:
            vehicle.step(dt)
        others = self.vehicles + self.objects
        position = np.array([other.position for other in others])
        diagonal = np.array([other.diagonal for other in others])
        reach = diagonal / 2 + np.array([other.speed for other in others]) * dt
        gap = np.hypot(*(position[:, None] - position).transpose(2, 0, 1)) - reach[:, None] - diagonal / 2
        for i, j in np.argwhere(np.triu(gap < 1e-6, 1)[: len(self.vehicles)]).tolist():
            self.vehicles[i].handle_collisions(others[j], dt)

    def neighbour_vehicles(
        self, vehicle: Vehicle, lane_index: LaneIndex | None = None
    ) -> tuple[Vehicle | None, Vehicle | None]:
        """The cars before and behind a car.

        Args:
            vehicle: the car.
            lane_index: of the lane to look at; None for the car's.
        """
        network, (left, right, top, bottom) = self.network.surroundings(lane_index or vehicle.lane_index)
        others = [other for other in self.vehicles + self.objects if other is not vehicle]
        x, y = np.array([other.position for other in others] or [[math.nan, math.nan]]).T
        inside = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        near = [others[k] for k in np.flatnonzero(inside.any(0)).tolist()]
        if not near:
            return None, None
        around = Road(network, near, None, self.np_random, False, self.neighbour_vehicles_connected_lanes)
        return around.neighbour_vehicles(vehicle, lane_index)


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


def spawn(road: Road, count: int, vehicle_class: type[ControlledVehicle]) -> None:
    """Put cars on random places of the road's streets, apart from each other and from the cars that are there.

    Args:
        road: its lanes carry a ``manoeuvre``; its generator is used.
        count: how many cars.
        vehicle_class: of the cars.

    Raises:
        ValueError: there is no room for so many.
    """
    rng, already = road.np_random, len(road.vehicles)
    places: list[tuple[LaneIndex, AbstractLane, float]] = []
    for index, lane in road.network.lanes_dict().items():
        if lane.manoeuvre == SubTask.LANEFOLLOW:
            places += [(index, lane, s) for s in np.arange(rng.uniform(0, GAP), lane.length, GAP)]
    for k in rng.permutation(len(places)):
        if len(road.vehicles) == already + count:
            return
        index, lane, along = places[k]
        position, heading = lane.position(along, 0), lane.heading_at(along)
        if all(is_clear(position, heading, other) for other in road.vehicles):
            limit = min(CRUISE_SPEED, lane.speed_limit or CRUISE_SPEED)
            car = vehicle_class(road, position, heading, rng.uniform(0.7, 1.0) * limit, index, limit)
            if isinstance(car, IDMVehicle):
                car.randomize_behavior()
            road.vehicles.append(car)
    if len(road.vehicles) < already + count:
        raise ValueError(f"vehicles_count={count}, but only {len(road.vehicles) - already} cars fit; ask for fewer")


def is_clear(position: np.ndarray, heading: float, other: Vehicle) -> bool:
    """Whether a car can start somewhere in view of another: far enough from it, or in the oncoming lane."""
    return np.hypot(*(position - other.position)) > 0.99 * GAP or math.cos(heading - other.heading) < -0.5
