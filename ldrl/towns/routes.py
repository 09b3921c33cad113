"""The global planner: routes through a town from a keyword."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ldrl.subtasks import SubTask
from ldrl.towns.town import Town

__all__ = ["Command", "Route", "UnrealisableError", "plan_route", "plan_routes"]

PATH_SPACING = 1.0
"""Distance between two points of a route's path, m."""


class UnrealisableError(ValueError):
    """A town does not allow what a keyword asks for."""


class Command(Protocol):
    """What a keyword asks for at each junction; see :class:`ldrl.language.Keyword`."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def start(self) -> int:
        """The state before the first junction."""

    def step(self, state: int, options: Collection[SubTask]) -> tuple[SubTask, int] | None:
        """The manoeuvre to take at a junction, ``FINISH`` to stop before it, and the next state."""

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
        stops: whether it ends before a junction that the car must not enter.
    """

    town: Town
    lanes: tuple[int, ...]
    start: float
    end: float
    stops: bool = False

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
        starts = np.concatenate([[0.0], np.cumsum(self.town.lane_length[list(self.lanes)].double().cpu().numpy())[:-1]])
        which = np.clip(np.searchsorted(starts, distance, side="right") - 1, 0, len(self.lanes) - 1)
        lanes = [self.town.network.get_lane(self.town.lane_indices[lane]) for lane in self.lanes]
        along = distance - starts[which]
        return np.array([[*lanes[k].position(s, 0), lanes[k].heading_at(s)] for k, s in zip(which, along, strict=True)])


def plan_route(town: Town, command: Command, approach: int) -> Route:
    """The route that realises a keyword from one lane that leads into a junction.

    Args:
        town: the town.
        command: the keyword.
        approach: index of the first lane, see :meth:`Town.approaches`.

    Returns:
        The route, from the start of ``approach`` to the end of the lane after the last manoeuvre, or of the lane
        before the junction that the command stops at.

    Raises:
        UnrealisableError: a junction on the way does not offer what is asked for, or the way loops forever.
    """
    lanes, state, seen = [approach], command.start, set()
    while not command.done(state):
        ways = _ways_on(town, lanes[-1])
        if not ways or (lanes[-1], state) in seen:
            raise UnrealisableError(f"{command.name!r} from lane {approach} of {town.name!r} loops forever")
        seen.add((lanes[-1], state))
        # What the passenger sees: a street on the left counts, even where this lane does not lead into it.
        options = dict.fromkeys(option for way in ways.values() for option in town.lane_options[way[-1]])
        choice = command.step(state, options)
        if choice is not None and choice[0] == SubTask.FINISH:
            lanes += next(iter(ways.values()))[:-1]
            return Route(town, tuple(lanes), 0.0, float(town.lane_length[lanes[-1]]), stops=True)
        if choice is None or choice[0] not in ways:
            offered = ", ".join(option.name.lower() for option in ways)
            raise UnrealisableError(f"{command.name!r} meets a junction of {town.name!r} that offers only {offered}")
        lanes += ways[choice[0]]
        state = choice[1]
    behind = [lane for lane in town.successors(lanes[-1]) if town.lane_manoeuvre[lane] == SubTask.LANEFOLLOW]
    if not behind:
        raise UnrealisableError(f"{command.name!r} from lane {approach} of {town.name!r} ends between two junctions")
    return Route(town, (*lanes, behind[0]), 0.0, float(town.lane_length[behind[0]]))


def _ways_on(town: Town, lane: int) -> dict[SubTask, tuple[int, ...]]:
    """The lanes after ``lane`` up to and through the next junction, by what is done there; the first way of each."""
    ways: dict[SubTask, tuple[int, ...]] = {}
    paths: list[tuple[int, ...]] = [()]
    seen = {lane}
    for path in paths:  # grows on the way: where lanes part before the junction, all of them are looked at
        for following in town.successors(path[-1] if path else lane):
            manoeuvre = SubTask(int(town.lane_manoeuvre[following]))
            if manoeuvre != SubTask.LANEFOLLOW:
                ways.setdefault(manoeuvre, (*path, following))
            elif following not in seen:
                seen.add(following)
                paths.append((*path, following))
    return ways


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
