"""Short street layouts in YAML, expanded into highway-env road networks whose lanes know their manoeuvre.

A layout names nodes and the straight two-way streets between them. A node with two streets is a corner, one with
three or four a junction. Frame: metres, x east, y south, headings in radians clockwise from east; traffic keeps right,
one lane each way. So the right of a heading ``(cos h, sin h)`` is ``(-sin h, cos h)`` and a positive turn is a right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
from highway_env.road.road import RoadNetwork

from ldrl.subtasks import SubTask

__all__ = ["LAYOUTS", "Layout", "Node", "load_layout"]

FOLDER = Path(__file__).parent / "layouts"
LAYOUTS = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))
"""The names of the layouts that come with the package."""
SPEED_LIMIT = 20 / 3.6  # m/s
STRAIGHT_ON = math.radians(1.0)
"""Smaller turns are straight lanes, and junction arms may be this far from perpendicular."""


class Node(NamedTuple):
    """Where streets meet: a position and the radius at which their centre lines turn into each other, in metres."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Layout:
    """Nodes and streets of a town, checked when made.

    Args:
        name: the town's name, for messages.
        lane_width: width of every lane, in metres.
        nodes: the nodes by name.
        streets: node names along straight streets; consecutive ones are joined.

    Raises:
        ValueError: if no network can be made of it; the message names the node or street and the remedy.

    Examples:
        >>> corners = {"nw": Node(0, 0, 8), "ne": Node(50, 0, 8), "se": Node(50, 50, 8), "sw": Node(0, 50, 8)}
        >>> network = Layout("ring", 4.0, corners, (("nw", "ne", "se", "sw", "nw"),)).network()
        >>> len(network.lanes_list()), network.get_lane(("nw>ne:end", "ne>se:start", 0)).radius
        (16, 6.0)
    """

    name: str
    lane_width: float
    nodes: Mapping[str, Node]
    streets: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        self._check_values()
        self._check_blocks()
        self._check_arms()
        self._check_lengths()

    @classmethod
    def from_yaml(cls, path: str | Path) -> Layout:
        """Read a layout file: the keys ``name``, ``lane_width``, ``nodes`` ([x, y, radius] by name) and ``streets``.

        Raises:
            ValueError: if the file is no layout or no network can be made of it.
        """
        data: Any = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        keys = {"name", "lane_width", "nodes", "streets"}
        if not isinstance(data, dict) or set(data) != keys:
            raise ValueError(f"layout {path}: expected exactly the keys {sorted(keys)}, got {data!s:.200}")
        name, nodes, streets = data["name"], data["nodes"], data["streets"]
        if not isinstance(nodes, dict):
            raise ValueError(f"layout {name!r}: nodes must map names to [x, y, radius], got {nodes!s:.200}")
        for node, values in nodes.items():
            if not isinstance(values, list) or len(values) != 3:
                raise ValueError(f"layout {name!r}: node {node!r} is {values!r}; write [x, y, radius]")
        if not isinstance(streets, list) or not all(isinstance(street, list) for street in streets):
            raise ValueError(f"layout {name!r}: streets must be a list of lists of node names, got {streets!s:.200}")
        nodes = {node: Node(*values) for node, values in nodes.items()}
        return cls(name, data["lane_width"], nodes, tuple(map(tuple, streets)))

    def network(self) -> RoadNetwork:
        """Expand the layout.

        The lane of the street from ``a`` to ``b`` is the edge ``("a>b:start", "a>b:end")``; the one that joins it to
        the street on to ``c`` is ``("a>b:end", "b>c:start")``.

        Returns:
            A new network; each lane has the attribute ``manoeuvre``, a ``SubTask``.
        """
        network = RoadNetwork()
        for a, b in self._blocks:  # the striped centre line belongs to one of the two lanes, so it is drawn once
            network.add_lane(f"{a}>{b}:start", f"{a}>{b}:end", self._street_lane(a, b, LineType.STRIPED))
            network.add_lane(f"{b}>{a}:start", f"{b}>{a}:end", self._street_lane(b, a, LineType.NONE))
        for node, arms in self._arms.items():
            for a, b in permutations(arms, 2):
                network.add_lane(f"{a}>{node}:end", f"{node}>{b}:start", self._joining_lane(a, node, b))
        return network

    @cached_property
    def _blocks(self) -> list[tuple[str, str]]:
        """The pairs of nodes that a street joins."""
        return [block for street in self.streets for block in pairwise(street)]

    @cached_property
    def _arms(self) -> dict[str, list[str]]:
        """The neighbours of each node."""
        return {node: [b if a == node else a for a, b in self._blocks if node in (a, b)] for node in self.nodes}

    def _heading(self, a: str, b: str) -> float:
        return math.atan2(self.nodes[b].y - self.nodes[a].y, self.nodes[b].x - self.nodes[a].x)

    def _turn(self, a: str, node: str, b: str) -> float:
        """The change of heading from ``a`` over ``node`` to ``b``, in [-pi, pi]."""
        return math.remainder(self._heading(node, b) - self._heading(a, node), math.tau)

    def _setback(self, node: str) -> float:
        """How far from the node its streets end: the tangent length of the turning centre line."""
        arms, radius = self._arms[node], self.nodes[node].radius
        turn = abs(self._turn(arms[0], node, arms[1]))
        return radius * math.tan(turn / 2) if len(arms) == 2 and turn > STRAIGHT_ON else radius

    def _lane_end(self, node: str, arm: str, side: int) -> np.ndarray:
        """Where a lane of an arm ends near the node: for ``side`` 1 the one that leaves it, for -1 the other."""
        heading, along, across = self._heading(node, arm), self._setback(node), side * self.lane_width / 2
        (x, y, _), cos, sin = self.nodes[node], math.cos(heading), math.sin(heading)
        return np.array((x + along * cos - across * sin, y + along * sin + across * cos))

    def _street_lane(self, a: str, b: str, centre_line: int) -> AbstractLane:
        ends = self._lane_end(a, b, side=1), self._lane_end(b, a, side=-1)
        lane = StraightLane(*ends, self.lane_width, (centre_line, LineType.CONTINUOUS), speed_limit=SPEED_LIMIT)
        lane.manoeuvre = SubTask.LANEFOLLOW
        return lane

    def _joining_lane(self, a: str, node: str, b: str) -> AbstractLane:
        """The lane of a corner or junction from the street from ``a`` to the street to ``b``."""
        turn, start = self._turn(a, node, b), self._lane_end(node, a, side=-1)
        lines, manoeuvre = (LineType.NONE, LineType.NONE), SubTask.RIGHT if turn > 0 else SubTask.LEFT
        if len(self._arms[node]) == 2:
            centre_line = LineType.STRIPED if a == self._arms[node][0] else LineType.NONE
            lines, manoeuvre = (centre_line, LineType.CONTINUOUS), SubTask.LANEFOLLOW
        elif abs(turn) <= STRAIGHT_ON:
            manoeuvre = SubTask.STRAIGHT
        look = {"width": self.lane_width, "line_types": lines, "speed_limit": SPEED_LIMIT}
        if abs(turn) <= STRAIGHT_ON:
            lane = StraightLane(start, self._lane_end(node, b, side=1), **look)
        else:
            phase = self._heading(a, node) - math.copysign(math.pi / 2, turn)
            radius = self._setback(node) / math.tan(abs(turn) / 2) - math.copysign(self.lane_width / 2, turn)
            centre = start - radius * np.array((math.cos(phase), math.sin(phase)))
            lane = CircularLane(centre, radius, phase, phase + turn, clockwise=turn > 0, **look)
        lane.manoeuvre = manoeuvre
        return lane

    def _error(self, message: str) -> ValueError:
        return ValueError(f"layout {self.name!r}: {message}")

    def _check_values(self) -> None:
        for name, node in self.nodes.items():
            for value in (self.lane_width, *node):
                if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                    raise self._error(f"node {name!r} and lane_width: {value!r} is no number; write metres")
            if not 0 < self.lane_width <= node.radius:
                wanted = f"at least lane_width {self.lane_width} > 0"
                raise self._error(f"node {name!r}: radius {node.radius} must be {wanted}; enlarge it")

    def _check_blocks(self) -> None:
        for i, (a, b) in enumerate(self._blocks):
            for node in (a, b):
                if node not in self.nodes:
                    raise self._error(f"street {a}-{b}: unknown node {node!r}; add it or use one of {list(self.nodes)}")
            if {a, b} in map(set, self._blocks[:i]):
                raise self._error(f"street {a}-{b} is listed twice; remove one")

    def _check_arms(self) -> None:
        for node, arms in self._arms.items():
            if len(arms) < 2:
                raise self._error(f"node {node!r} is a dead end, {len(arms)} street(s); join two or more to it")
            for a, b in permutations(arms, 2):
                turn = abs(self._turn(a, node, b))
                if len(arms) > 2 and min(turn, abs(turn - math.pi / 2)) > STRAIGHT_ON:
                    apart = f"{a!r} and {b!r} are {180 - math.degrees(turn):.1f} degrees apart"
                    raise self._error(f"junction {node!r}: {apart}; make it 90 or 180")

    def _check_lengths(self) -> None:
        for a, b in self._blocks:
            length, needed = math.dist(self.nodes[a][:2], self.nodes[b][:2]), self._setback(a) + self._setback(b)
            if length <= needed:
                problem = f"street {a}-{b} is {length:.1f} m long, the turns at its ends need {needed:.1f} m"
                raise self._error(f"{problem}; move its nodes apart or reduce their radii")


def load_layout(name: str) -> Layout:
    """Load a layout that comes with the package.

    Raises:
        ValueError: if there is none of that name.

    Examples:
        >>> load_layout("town2").lane_width
        4.0
    """
    if name not in LAYOUTS:
        raise ValueError(f"unknown layout {name!r}; there are {', '.join(LAYOUTS)}")
    return Layout.from_yaml(FOLDER / f"{name}.yaml")
