"""A highway-env lane along any curve, given by dense samples of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.utils import get_class_path

from ldrl.towns.layout import SPEED_LIMIT

__all__ = ["PolylineLane"]


class PolylineLane(AbstractLane):
    """A lane whose centre line, heading and width are interpolated between samples; it runs on straight beyond them.

    highway-env's ``PolyLane`` searches its curve in Python loops, and takes headings from the points alone. Here a
    look-up is a few numpy calls, and headings are given, so that points may lie on each other or a little off.

    Args:
        points: ``[N, 2]``, m.
        headings: ``[N]``, directions of the centre line, rad.
        widths: ``[N]``, m.
        line_types: of the left and of the right side.
        forbidden: whether cars may not change to this lane.
        speed_limit: m/s.
        priority: who has the right of way.

    Examples:
        >>> lane = PolylineLane([(0, 0), (10, 0), (20, 0)], [0, 0, 0], [4, 3, 3])
        >>> lane.local_coordinates((5, 1)), float(lane.width_at(5))
        ((5.0, 1.0), 3.5)
    """

    def __init__(
        self,
        points: Any,
        headings: Any,
        widths: Any,
        line_types: tuple[int, int] = (LineType.NONE, LineType.NONE),
        forbidden: bool = False,
        speed_limit: float = SPEED_LIMIT,
        priority: int = 0,
    ) -> None:
        super().__init__()
        self.points = np.asarray(points, np.float64)
        self._x, self._y = self.points.T.copy()  # contiguous, for np.interp
        self.headings = np.unwrap(np.asarray(headings, np.float64))
        self.widths = np.asarray(widths, np.float64)
        self.stations = np.concatenate(([0.0], np.hypot(*np.diff(self.points, axis=0).T).cumsum()))
        self.length = float(self.stations[-1])
        self.line_types = line_types
        self.forbidden = forbidden
        self.speed_limit = speed_limit
        self.priority = priority

    def position(self, longitudinal: float, lateral: float) -> np.ndarray:
        """The point at arc length ``longitudinal``, ``lateral`` to the right of the centre line, m."""
        x = np.interp(longitudinal, self.stations, self._x)
        y = np.interp(longitudinal, self.stations, self._y)
        heading = self.heading_at(longitudinal)
        beyond = longitudinal - min(max(longitudinal, 0.0), self.length)
        cos, sin = np.cos(heading), np.sin(heading)
        return np.array((x + beyond * cos - lateral * sin, y + beyond * sin + lateral * cos))

    def heading_at(self, longitudinal: float) -> float:
        """The direction of the centre line, rad."""
        return float(np.interp(longitudinal, self.stations, self.headings))

    def width_at(self, longitudinal: float) -> float:
        """The width, m."""
        return float(np.interp(longitudinal, self.stations, self.widths))

    def local_coordinates(self, position: np.ndarray) -> tuple[float, float]:
        """Arc length of the nearest point of the centre line, and the distance to its right, m."""
        nearest = int(np.argmin((self._x - position[0]) ** 2 + (self._y - position[1]) ** 2))
        longitudinal = float(self.stations[nearest])
        for _ in range(2):  # along the tangent: first of the nearest sample, then of the point found so
            heading = self.heading_at(longitudinal)
            x, y = position - self.position(longitudinal, 0)
            longitudinal += float(x * np.cos(heading) + y * np.sin(heading))
            lateral = float(y * np.cos(heading) - x * np.sin(heading))
        return longitudinal, lateral

    @classmethod
    def from_config(cls, config: dict) -> PolylineLane:
        """The lane that :meth:`to_config` wrote."""
        return cls(**config)

    def to_config(self) -> dict:
        """The lane as JSON values."""
        return {
            "class_path": get_class_path(type(self)),
            "config": {
                "points": self.points.tolist(),
                "headings": self.headings.tolist(),
                "widths": self.widths.tolist(),
                "line_types": list(self.line_types),
                "forbidden": self.forbidden,
                "speed_limit": self.speed_limit,
                "priority": self.priority,
            },
        }
