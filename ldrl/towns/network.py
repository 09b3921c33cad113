"""A highway-env road network that finds the lane under a car without looking at every lane of the map."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, RoadNetwork

__all__ = ["IndexedNetwork"]

CELL = 8.0
"""Edge of a cell of the index, m."""
LANE_SPACING = 1.0
"""Largest distance between two samples of a lane's centre line, m."""
SURELY = 0.9
"""A lane's own distance may fall short of the Euclidean one by a tenth: at the kinks of sampled centre lines and
beyond the ends of wavy ones."""
REACH = 12.0
"""How much further than its nearest lane a cell lists lanes, m; a heading against the lane counts as 3.1 m."""
BESIDE = 1.5
"""highway-env takes a car for being on a lane up to 1 m beside it, and 5 m beyond its ends, m."""


class _Candidate(NamedTuple):
    bound: float
    """No position in the cell is closer to the lane, m."""
    order: int
    """Place in the network, which decides between lanes that are equally close."""
    index: LaneIndex
    lane: AbstractLane


class Surroundings(NamedTuple):
    """What is near a road."""

    network: RoadNetwork
    """The road, those that lead into it and those that follow it, in the order of the whole network."""
    boxes: np.ndarray
    """``[4, N, 1]`` float64: smallest and largest x, smallest and largest y (m) of the cars on each of their lanes."""


class IndexedNetwork(RoadNetwork):
    """A :class:`~highway_env.road.road.RoadNetwork` with a spatial index; its answers are the same.

    For each 8 m cell that a car has been in, it keeps the lanes around with a lower bound of their distance, and
    looks at them in that order until no other can be closer. Lanes of any type will do. Those put into ``graph``
    after the first look-up are not seen; use :meth:`add_lane`.

    Args:
        graph: lanes by start and end node, as in a ``RoadNetwork``, which may share it.

    Examples:
        >>> from ldrl.towns import load_layout
        >>> network = IndexedNetwork(load_layout("town1").network().graph)
        >>> network.get_closest_lane_index([200.0, 2.0], heading=3.1)
        ('c1>d1:start', 'c1>d1:end', 0)
    """

    def __init__(self, graph: dict[str, dict[str, list[AbstractLane]]] | None = None) -> None:
        super().__init__()
        self.graph = {} if graph is None else graph
        self._forget()

    def _forget(self) -> None:
        self._lanes: list[tuple[LaneIndex, AbstractLane]] = []
        self._cells: dict[tuple[int, int], list[_Candidate]] = {}
        self._surroundings: dict[tuple[str, str], Surroundings] = {}

    def add_lane(self, _from: str, _to: str, lane: AbstractLane) -> None:
        """Add a lane; the index is built anew."""
        super().add_lane(_from, _to, lane)
        self._forget()

    def get_closest_lane_index(self, position: np.ndarray, heading: float | None = None) -> LaneIndex:
        """The lane with the smallest distance, counting 1 m for each radian between its heading and the car's.

        Args:
            position: x and y, m.
            heading: of the car, rad; None to go by distance alone.
        """
        position = np.asarray(position)
        best, first, closest = math.inf, 0, None
        for bound, order, index, lane in self._candidates(position):
            if bound > best:
                return closest
            distance = lane.distance_with_heading(position, heading)
            if distance < best or (distance == best and order < first):
                best, first, closest = distance, order, index
        return super().get_closest_lane_index(position, heading)  # the closest may be one that the cell doesn't list

    def _candidates(self, position: np.ndarray) -> list[_Candidate]:
        """The lanes around a position's cell by their bounds; the last bound tells how far the list is complete."""
        x, y = position.tolist()
        if not math.isfinite(x + y):
            return []
        cell = math.floor(x / CELL), math.floor(y / CELL)
        if cell not in self._cells:
            self._cells[cell] = self._list_candidates(cell)
        return self._cells[cell]

    def _list_candidates(self, cell: tuple[int, int]) -> list[_Candidate]:
        if not self._lanes:
            self._sample_lanes()
        centre = (np.array(cell) + 0.5) * CELL
        distance = np.minimum.reduceat(np.hypot(*(self._points - centre).T), self._first)
        bounds = SURELY * (distance - CELL * math.sqrt(0.5) - LANE_SPACING / 2)
        nearest_first = np.argsort(bounds, kind="stable")
        near = int((bounds <= bounds.min() + REACH).sum())
        listed = [_Candidate(float(bounds[k]), int(k), *self._lanes[k]) for k in nearest_first[: near + 1]]
        return listed if near < len(bounds) else [*listed, listed[-1]._replace(bound=math.inf)]

    def _sample_lanes(self) -> None:
        self._lanes = list(self.lanes_dict().items())
        samples = [centre_line(lane) for _, lane in self._lanes]
        self._points = np.concatenate(samples)
        self._first = np.cumsum([0] + [len(points) for points in samples[:-1]])

    def surroundings(self, index: LaneIndex) -> Surroundings:
        """A road with those that lead into it and those that follow it.

        Args:
            index: of a lane of the road.
        """
        start, end, _ = index
        if (start, end) not in self._surroundings:
            network = RoadNetwork()
            for node, ends in self.graph.items():
                kept = {to: ends[to] for to in ends if node == end or to == start or (node, to) == (start, end)}
                if kept:
                    network.graph[node] = kept
            boxes = np.array([box(lane) for lane in network.lanes_list()])
            self._surroundings[start, end] = Surroundings(network, boxes.T[..., None])
        return self._surroundings[start, end]


def centre_line(lane: AbstractLane, beyond: float = 0.0) -> np.ndarray:
    """Samples of a lane's centre line, both ends included and so far beyond them (m): ``[N, 2]`` float64, m."""
    pieces = max(1, math.ceil((lane.length + 2 * beyond) / LANE_SPACING))
    return np.array([lane.position(s, 0) for s in np.linspace(-beyond, lane.length + beyond, pieces + 1)])


def box(lane: AbstractLane) -> tuple[float, float, float, float]:
    """A box that holds all cars which highway-env takes for being on a lane."""
    points = centre_line(lane, lane.VEHICLE_LENGTH)
    margin = max(lane.width_at(s) for s in np.linspace(0, lane.length, 9)) / 2 + BESIDE
    (left, top), (right, bottom) = points.min(0) - margin, points.max(0) + margin
    return left, right, top, bottom
