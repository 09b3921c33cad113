"""highway-env's road, made fast enough for towns."""

from __future__ import annotations

import math

import numpy as np
from highway_env.road.road import LaneIndex, Road
from highway_env.vehicle.kinematics import Vehicle

from ldrl.towns.network import IndexedNetwork

__all__ = ["IndexedRoad"]


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
