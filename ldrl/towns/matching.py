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
        The route from the start to the path's last point that passes within 3 m of all its points, in order. Where
        several do, the one with the smallest sum of distances from the points and detours between them.

    Raises:
        ValueError: the start is off the road or faces against its lane, or the path leaves the lanes.
    """
    matcher = _Matcher(town, start, path)
    heap, seen, furthest = matcher.begin(), set(), 0
    while heap:  # best first; a state is where on which lane and how many points are behind
        match = heappop(heap)
        if match.passed == len(path):
            return Route(town, match.lanes, match.start, match.along)
        state = match.lanes[-1], match.passed
        if state in seen:
            continue
        seen.add(state)
        match = matcher.along_lane(match)
        furthest = max(furthest, match.passed)
        for following in [match] if match.passed == len(path) else matcher.onwards(match):
            heappush(heap, following)
    raise matcher.error(furthest)


class _Match(NamedTuple):
    """A route under way; the first field orders them."""

    cost: float
    """Sum of the points' distances, and by how much the route is longer than the path, m."""
    lanes: tuple[int, ...]
    start: float
    """Where on the first lane it starts, m."""
    along: float
    """Where on the last lane it is, m."""
    passed: int
    """Points that it has passed."""
    since: float
    """Distance driven since the last of them, m."""


class _Matcher:
    def __init__(self, town: Town, start: Sequence[float], path: Sequence[Sequence[float]]) -> None:
        self.town = town
        self.start = tuple(start)
        self.path = np.asarray(path, np.float64)
        self.steps = np.hypot(*np.diff(self.path, axis=0, prepend=np.array([self.start[:2]])).T)
        self.points = town.points.double().cpu().numpy()
        self.headings = town.headings.double().cpu().numpy()
        self.first = town.lane_first.cpu().numpy()
        self.length = town.lane_length.double().cpu().numpy()
        self.pieces = np.diff(self.first, append=len(self.points)) - 1

    def begin(self) -> list[_Match]:
        """The lanes under the start."""
        distance = np.hypot(*(self.points - self.start[:2]).T)
        turned = np.abs((self.headings - self.start[2] + math.pi) % (2 * math.pi) - math.pi)
        if distance.min() > TOLERANCE:
            raise ValueError(
                f"start {list(self.start)} is {distance.min():.1f} m from the nearest lane of {self.town.name!r}; "
                f"move it within {TOLERANCE:g} m of one"
            )
        near = np.flatnonzero((distance <= TOLERANCE) & (turned < HEADING_TOLERANCE))
        if not len(near):
            raise ValueError(
                f"start {list(self.start)} faces against its lane in {self.town.name!r}; turn its heading (rad) around"
            )
        found = []
        for lane in np.unique(np.searchsorted(self.first, near, side="right") - 1).tolist():
            along, gap = self.project(lane, np.array(self.start[:2]), 0.0)
            along = min(max(along, 0.0), float(self.length[lane]))
            found.append(_Match(gap, (lane,), along, along, 0, 0.0))
        return found

    def project(self, lane: int, point: np.ndarray, begin: float) -> tuple[float, float]:
        """Where on a lane's line, not before ``begin``, a point is nearest, and how far it is from there, m.

        The line runs on straight beyond the lane's end.
        """
        spacing = float(self.length[lane]) / int(self.pieces[lane])
        skipped = min(int(begin / spacing), int(self.pieces[lane]))
        first, last = self.first[lane] + skipped, self.first[lane] + self.pieces[lane]
        nearest = int(((self.points[first : last + 1] - point) ** 2).sum(1).argmin())
        (x, y), heading = (point - self.points[first + nearest]).tolist(), float(self.headings[first + nearest])
        along = (skipped + nearest) * spacing + x * math.cos(heading) + y * math.sin(heading)
        return max(along, begin), math.hypot(y * math.cos(heading) - x * math.sin(heading), max(begin - along, 0.0))

    def along_lane(self, match: _Match) -> _Match:
        """Drive to the end of the last lane, or to the path's last point, and pass the points on the way."""
        cost, lanes, start, begin, passed, since = match
        length = float(self.length[lanes[-1]])
        while passed < len(self.path):
            along, gap = self.project(lanes[-1], self.path[passed], begin)
            if gap > TOLERANCE or along > length:
                break
            cost += gap + along - begin - float(self.steps[passed])
            begin, passed, since = along, passed + 1, 0.0
        if passed < len(self.path):
            cost, begin, since = cost + length - begin, length, since + length - begin
        return _Match(cost, lanes, start, begin, passed, since)

    def onwards(self, match: _Match) -> Iterator[_Match]:
        """The ways on at the end of the last lane."""
        if match.since <= DETOUR_FACTOR * self.steps[match.passed] + DETOUR:
            for lane in self.town.successors(match.lanes[-1]):
                yield match._replace(lanes=(*match.lanes, lane), along=0.0)

    def error(self, k: int) -> ValueError:
        """Why the path cannot be followed to its point ``k``."""
        point, distance = self.path[k].tolist(), float(np.hypot(*(self.points - self.path[k]).T).min())
        name = self.town.name
        if distance > TOLERANCE:
            return ValueError(
                f"path point {k} {point} is {distance:.1f} m from the nearest lane of {name!r}; "
                f"move it within {TOLERANCE:g} m of one"
            )
        return ValueError(
            f"path point {k} {point} is on no lane of {name!r} that leads on from the point before; "
            "list points in driving order, closer together"
        )
