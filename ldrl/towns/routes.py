"""The global planner: routes through a town, from a keyword or along a path."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from ldrl.subtasks import SubTask
from ldrl.towns.town import Town

__all__ = ["Command", "Route", "UnrealisableError", "match_route", "plan_route", "plan_routes"]

PATH_SPACING = 1.0
"""Distance between two points of a route's path, m."""
MATCH_TOLERANCE = 3.0
"""How far a path may lie from the lanes that it is matched to, m."""
MATCH_HEADING = math.radians(75)
"""How far a start may turn away from its lane, rad."""


class UnrealisableError(ValueError):
    """A town does not allow what a keyword asks for."""


class Command(Protocol):
    """What a keyword asks for at each junction; see :class:`ldrl.language.Keyword`."""

    name: str
    start: int

    def step(self, state: int, options: Collection[SubTask]) -> tuple[SubTask, int] | None:
        """The manoeuvre to take at a junction, and the next state."""

    def done(self, state: int) -> bool:
        """Whether nothing is left to do."""


@dataclass(frozen=True)
class Route:
    """A way through a town.

    Args:
        town: the town.
        lanes: lane indices, each a successor of the one before.
        start: where on the first lane it starts, m.
        end: where on the last lane it ends, m.
    """

    town: Town
    lanes: tuple[int, ...]
    start: float
    end: float

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.town.lane_length[list(self.lanes[:-1])].sum()) + self.end - self.start

    @property
    def manoeuvres(self) -> tuple[SubTask, ...]:
        """What is done at its junctions, in order."""
        found = (SubTask(int(m)) for m in self.town.lane_manoeuvre[list(self.lanes)])
        return tuple(m for m in found if m != SubTask.LANEFOLLOW)

    def poses(self, spacing: float = PATH_SPACING) -> np.ndarray:
        """Poses along the centre line, both ends included.

        Args:
            spacing: largest distance between two of them, m.

        Returns:
            ``[N, 3]`` float64: x, y (m) and heading (rad).
        """
        distance = np.linspace(0, self.length, max(1, math.ceil(self.length / spacing)) + 1) + self.start
        starts = np.concatenate([[0.0], np.cumsum(self.town.lane_length[list(self.lanes)].double())[:-1]])
        which = np.clip(np.searchsorted(starts, distance, side="right") - 1, 0, len(self.lanes) - 1)
        lanes = [self.town.network.get_lane(self.town.lane_indices[lane]) for lane in self.lanes]
        along = distance - starts[which]
        return np.array(
            [[*lanes[k].position(s, 0), lanes[k].heading_at(s)] for k, s in zip(which, along, strict=True)]
        )


def plan_route(town: Town, command: Command, approach: int) -> Route:
    """The route that realises a keyword from one lane that leads into a junction.

    Args:
        town: the town.
        command: the keyword.
        approach: index of the first lane, see :meth:`Town.approaches`.

    Returns:
        The route, from the start of ``approach`` to the end of the lane after the last manoeuvre.

    Raises:
        UnrealisableError: a junction on the way does not offer what is asked for, or the way loops forever.
    """
    lanes, state, seen = [approach], command.start, set()
    while True:
        following = town.successors(lanes[-1])
        options = {SubTask(int(town.lane_manoeuvre[lane])): lane for lane in following}
        if SubTask.LANEFOLLOW in options:
            lanes.append(options[SubTask.LANEFOLLOW])
            if command.done(state):
                return Route(town, tuple(lanes), 0.0, float(town.lane_length[lanes[-1]]))
            continue
        if (lanes[-1], state) in seen:
            raise UnrealisableError(f"{command.name!r} from lane {approach} of {town.name!r} loops forever")
        seen.add((lanes[-1], state))
        choice = command.step(state, options)
        if choice is None:
            offered = ", ".join(option.name.lower() for option in options)
            raise UnrealisableError(f"{command.name!r} meets a junction of {town.name!r} that offers only {offered}")
        lanes.append(options[choice[0]])
        state = choice[1]


def plan_routes(town: Town, command: Command) -> list[Route]:
    """Every distinct route that realises a keyword, one for each approach to a junction that allows it.

    Args:
        town: the town.
        command: the keyword.

    Raises:
        UnrealisableError: the town allows none.
    """
    routes, reasons = [], []
    for approach in town.approaches():
        try:
            routes.append(plan_route(town, command, approach))
        except UnrealisableError as error:
            reasons.append(str(error))
    if not routes:
        raise UnrealisableError(
            f"{town.name!r} cannot realise {command.name!r} from any of its {len(reasons)} approaches to junctions; "
            f"use another town or keyword. For example: {reasons[0] if reasons else 'it has no junction'}"
        )
    return routes


def match_route(town: Town, start: Sequence[float], path: Sequence[Sequence[float]]) -> Route:
    """The route along a path of points.

    Args:
        town: the town.
        start: x, y (m) and heading (rad).
        path: at least one point ``[x, y]`` (m), in driving order.

    Returns:
        The route whose lanes follow the path from the start to the path's last point.

    Raises:
        ValueError: the start is off the road or faces against its lane, or the path leaves the lanes.
    """
    points = np.asarray(path, np.float64)
    origin = np.asarray(start, np.float64)
    samples = town.points.double().cpu().numpy()
    headings = town.headings.double().cpu().numpy()
    distance = np.hypot(*(samples - origin[:2]).T)
    turned = np.abs((headings - origin[2] + math.pi) % (2 * math.pi) - math.pi)
    if distance.min() > MATCH_TOLERANCE:
        raise ValueError(
            f"start {list(start)} is {distance.min():.1f} m from the nearest lane of {town.name!r}; "
            f"move it within {MATCH_TOLERANCE:g} m of one"
        )
    near = (distance <= min(distance[turned < MATCH_HEADING].min(initial=math.inf), MATCH_TOLERANCE) + 0.25) & (
        turned < MATCH_HEADING
    )
    if not near.any():
        raise ValueError(f"start {list(start)} faces against its lane in {town.name!r}; turn its heading (rad) around")
    first = town.lane_first.cpu().numpy()
    lane_of = np.searchsorted(first, np.flatnonzero(near), side="right") - 1
    candidates = [_follow(town, int(lane), origin[:2], points) for lane in dict.fromkeys(lane_of.tolist())]
    route, error = min(candidates, key=lambda candidate: candidate[1].max())
    if error.max() > MATCH_TOLERANCE:
        k = int((error > MATCH_TOLERANCE).argmax())
        raise ValueError(
            f"path point {k} {points[k].tolist()} is {error[k]:.1f} m from the lanes of {town.name!r} that the path "
            f"follows; points must lie within {MATCH_TOLERANCE:g} m of lanes, in driving order"
        )
    return route


def _follow(town: Town, lane: int, origin: np.ndarray, points: np.ndarray) -> tuple[Route, np.ndarray]:
    """Follow ``points`` from ``lane`` on; the route, and each point's distance from it."""
    track = np.concatenate([origin[None], points])
    remaining = float(np.hypot(*np.diff(track, axis=0).T).sum()) + MATCH_TOLERANCE

    def to_track(lane: int, reach: float) -> float:
        index = int(town.lane_first[lane]) + torch.arange(int(town.lane_length[lane] / town.lane_spacing[lane]) + 1)
        ahead = town.points[index[: max(2, int(reach / float(town.lane_spacing[lane])))]].double().cpu().numpy()
        return float(np.hypot(*(ahead[:, None] - track[None]).transpose(2, 0, 1)).min(1).mean())

    start, _ = town.network.get_lane(town.lane_indices[lane]).local_coordinates(origin)
    start = float(np.clip(start, 0.0, float(town.lane_length[lane])))
    lanes = [lane]
    driven = float(town.lane_length[lane]) - start
    while driven < remaining:
        best = min(town.successors(lanes[-1]), key=lambda option: to_track(option, remaining - driven))
        lanes.append(best)
        driven += float(town.lane_length[best])
    poses = Route(town, tuple(lanes), start, float(town.lane_length[lanes[-1]])).poses(0.5)
    gaps = np.hypot(*(points[:, None] - poses[None, :, :2]).transpose(2, 0, 1))
    end = int(gaps[-1].argmin()) * 0.5 + start
    while len(lanes) > 1 and end < sum(float(town.lane_length[k]) for k in lanes[:-1]):
        lanes.pop()
    end -= sum(float(town.lane_length[k]) for k in lanes[:-1])
    return Route(town, tuple(lanes), start, end), gaps.min(1)
