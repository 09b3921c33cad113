"""From a path of points to the route along it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from ldrl.towns.routes import Route
from ldrl.towns.town import Town

__all__ = ["match_route"]

TOLERANCE = 3.0
"""How far a start or a path may lie from the lanes that it is matched to, m."""
HEADING_TOLERANCE = math.radians(75)
"""How far a start may turn away from its lane, rad."""
DETOUR_FACTOR, DETOUR = 3.0, 20.0
"""Between two points a route may be three times as long as the straight line, and 20 m longer."""


def match_route(town: Town, start: Sequence[float], path: Sequence[Sequence[float]]) -> Route:
    """The route along a path of points, however far apart and however often it comes by the same place.

    Args:
        town: the town.
        start: x, y (m) and heading (rad).
        path: at least one point ``[x, y]`` (m), in driving order.

    Returns:
        The route from the start to the path's last point that passes all its points in order, within 3 m. Where
        several do, the one with the smallest sum of distances to the points and detours between them.

    Raises:
        ValueError: the start is off the road or faces against its lane, or the path leaves the lanes.
    """
    lanes = _Lanes(town)
    origin, points = np.asarray(start[:2], np.float64), np.asarray(path, np.float64)
    steps = np.hypot(*np.diff(points, axis=0, prepend=origin[None]).T)
    heap = [_Search(0.0, (lane,), along, along, 0, 0.0) for lane, along in _first_lanes(lanes, start)]
    seen, furthest = set(), 0
    while heap:
        search = heappop(heap)
        if search.matched == len(points):
            return Route(town, search.lanes, search.start, search.along)
        if (search.lanes[-1], search.matched) in seen:
            continue
        seen.add((search.lanes[-1], search.matched))
        search = _match_lane(lanes, search, points, steps)
        furthest = max(furthest, search.matched)
        if search.matched == len(points):
            heappush(heap, search)
            continue
        for following in _next_lanes(lanes, search, steps):
            heappush(heap, following)
    raise _unmatched(lanes, furthest, points)


class _Search(NamedTuple):
    """A route under way, ordered by its cost."""

    cost: float  # distances to the points matched, and what the route is longer than the path, m
    lanes: tuple[int, ...]
    start: float  # on the first lane, m
    along: float  # on the last lane, m
    matched: int  # how many points
    unmatched: float  # distance driven since the last of them, m


class _Lanes:
    """The centre lines of a town in numpy."""

    def __init__(self, town: Town) -> None:
        self.town = town
        self.points = town.points.double().cpu().numpy()
        self.headings = town.headings.double().cpu().numpy()
        self.first = town.lane_first.cpu().numpy()
        self.length = town.lane_length.double().cpu().numpy()
        self.spacing = town.lane_spacing.double().cpu().numpy()

    def project(self, lane: int, point: np.ndarray, begin: float = 0.0) -> tuple[float, float]:
        """Arc length on the lane of the point's projection, behind ``begin``, and the distance, both in metres."""
        spacing, last = self.spacing[lane], round(self.length[lane] / self.spacing[lane])
        nearest = skip = min(int(begin / spacing), last)
        near = slice(self.first[lane] + skip, self.first[lane] + last + 1)
        nearest += int(((self.points[near] - point) ** 2).sum(1).argmin())
        heading = self.headings[self.first[lane] + nearest]
        right, forward = point - self.points[self.first[lane] + nearest] @ np.eye(2)
        cos, sin = math.cos(heading), math.sin(heading)
        along = nearest * spacing + right * cos + forward * sin
        outside = along - min(max(along, begin), self.length[lane])
        return along, math.hypot(forward * cos - right * sin, outside)
