"""highway-env's road with its traffic, made fast enough for towns."""

from __future__ import annotations

import copy
import math

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import LaneIndex, Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

from ldrl.envs.vehicle import CRUISE_SPEED
from ldrl.subtasks import SubTask
from ldrl.towns.network import IndexedNetwork

__all__ = ["IndexedRoad", "TownRoad", "TrafficVehicle", "spawn"]

GAP = 10.0
"""Smallest distance between the centres of two cars at the start, m."""
PLAN_LANES = 4
"""Lanes that a car's route goes on for; a prediction of 3 s looks at less."""


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
        left, right, top, bottom = self.network.surroundings(lane_index or vehicle.lane_index)

        def is_near(other: Vehicle) -> bool:
            x, y = other.position
            return left <= x <= right and top <= y <= bottom

        vehicles, objects = [v for v in self.vehicles if is_near(v)], [o for o in self.objects if is_near(o)]
        connected = self.neighbour_vehicles_connected_lanes
        return Road(self.network, vehicles, objects, self.np_random, False, connected).neighbour_vehicles(
            vehicle, lane_index
        )


class TownRoad(RegulatedRoad, IndexedRoad):
    """A :class:`~highway_env.road.regulation.RegulatedRoad` that predicts each car once, not once for each other."""

    def enforce_road_rules(self) -> None:
        """Stop the cars that have to yield and let go those that needn't any more."""
        self._predicted: dict[int, tuple[float, float, float, float]] = {}
        super().enforce_road_rules()

    def is_conflict_possible(self, v1: Vehicle, v2: Vehicle) -> bool:  # type: ignore[override]
        """Whether two cars come close within 3 s.

        Args:
            v1: a car.
            v2: another.
        """
        left1, right1, top1, bottom1 = self._predict(v1)
        left2, right2, top2, bottom2 = self._predict(v2)
        apart = max(left1 - right2, left2 - right1, top1 - bottom2, top2 - bottom1)
        return apart <= v1.LENGTH and bool(RegulatedRoad.is_conflict_possible(alone(v1), alone(v2)))

    def _predict(self, vehicle: Vehicle) -> tuple[float, float, float, float]:
        """A box that holds all positions that the conflict check looks at."""
        if id(vehicle) not in self._predicted:
            positions, _ = alone(vehicle).predict_trajectory_constant_speed(np.arange(0.25, 3, 0.25))
            (left, top), (right, bottom) = np.min(positions, 0), np.max(positions, 0)
            self._predicted[id(vehicle)] = float(left), float(right), float(top), float(bottom)
        return self._predicted[id(vehicle)]


def alone(vehicle: Vehicle) -> Vehicle:
    """The car without its road where its predictions don't need one: highway-env deep-copies what they run on."""
    if isinstance(vehicle, ControlledVehicle):
        return vehicle
    vehicle = copy.copy(vehicle)
    vehicle.road = vehicle.lane = None
    vehicle.history = type(vehicle.history)()
    vehicle.position = vehicle.position.copy()
    return vehicle


class TrafficVehicle(IDMVehicle):
    """highway-env's IDM car on an endless route: random at every junction, at most 20 km/h, never backwards."""

    def follow_road(self) -> None:
        """Go on to the next lane of the route near the end of one; draw the lanes behind the route's end."""
        self.route = self.route or [self.target_lane_index]
        while len(self.route) < PLAN_LANES:
            self.route.append(self._random_successor(self.route[-1]))
        super().follow_road()

    def _random_successor(self, index: LaneIndex) -> LaneIndex:
        network = self.road.network
        following = [(index[1], end, k) for end, lanes in network.graph[index[1]].items() for k in range(len(lanes))]
        return following[int(self.road.np_random.integers(len(following)))]

    def act(self, action: dict | str | None = None) -> None:
        """Decide; where the road's rules have reset the speed to aim for, it is capped again."""
        self.target_speed = min(self.target_speed, CRUISE_SPEED)
        super().act(action)

    def step(self, dt: float) -> None:
        """Move; IDM alone would back off from a car that stands too close ahead.

        Args:
            dt: time step, s.
        """
        self.action["acceleration"] = max(self.action["acceleration"], -self.speed / dt)
        super().step(dt)

    def predict_trajectory_constant_speed(self, times: np.ndarray) -> tuple:
        """Where it will be along its route; highway-env's own guess is a lane off just before a lane's end.

        Args:
            times: s.

        Returns:
            Positions (m) and headings (rad).
        """
        network, target = self.road.network, self.target_lane_index
        along, _ = network.get_lane(target).local_coordinates(self.position)
        route = self.route or [target]
        ahead = [network.position_heading_along_route(route, along + self.speed * t, 0, target) for t in times]
        return tuple(zip(*ahead, strict=True))


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
