"""What there is to do at junctions."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import NamedTuple

from ldrl.subtasks import SubTask
from ldrl.towns.opendrive.graph import Chain, Graph
from ldrl.towns.opendrive.lanes import LaneKey, LanePiece, forward
from ldrl.towns.opendrive.records import OpenDrive

__all__ = ["FOLLOW", "Task", "classify", "leave_out_u_turns"]

STRAIGHT_ON = math.radians(30)
"""A junction lane that turns less leads straight on."""
U_TURN = math.radians(150)
"""One that turns more is a U-turn."""

Way = tuple[str, bool]
"""A road, and whether it is driven forward."""


class Task(NamedTuple):
    """What is done on a lane, and all that its road of entry offers, on whichever lane."""

    manoeuvre: SubTask
    options: frozenset[SubTask]


FOLLOW = Task(SubTask.LANEFOLLOW, frozenset())


def leave_out_u_turns(graph: Graph[Chain], source: OpenDrive, pieces: dict[LaneKey, LanePiece]) -> None:
    """Remove junction lanes that turn by more than 150 degrees, where their road of entry has another way on.

    No keyword asks for them, and as lefts they would hide the street on the left.
    """
    for chains in _entries(graph, source).values():
        back = [chain for chain in chains if abs(_turn([pieces[key] for key in chain])[0]) > U_TURN]
        if len(back) < len(chains):
            for chain in back:
                graph.remove(chain)


def classify(graph: Graph[Chain], source: OpenDrive, pieces: dict[LaneKey, LanePiece]) -> dict[LaneKey, Task]:
    """What is done on each lane of a junction where there is a choice.

    Where all lanes of a road lead to one other road, there is nothing to say about it, as at a corner: they are
    ``LANEFOLLOW``, like lanes outside junctions. Else a lane that turns by less than 30 degrees is ``STRAIGHT``, others
    are ``LEFT`` or ``RIGHT``. Where several roads lie straight on, the straightest is ``STRAIGHT`` and the others are
    ``LEFT`` or ``RIGHT``, on whichever side of it they lie.

    Args:
        graph: all lanes, each with one before and one after it.
        source: the file.
        pieces: samples of its lanes.

    Returns:
        The tasks of all lanes that are not ``LANEFOLLOW``.
    """
    tasks: dict[LaneKey, Task] = {}
    for chains in _entries(graph, source).values():
        ways = {chain: _way(source, graph.after[chain][0][0]) for chain in chains}
        if len(set(ways.values())) == 1:
            continue
        turns = {chain: _turn([pieces[key] for key in chain]) for chain in chains}
        straight = [chain for chain in chains if abs(turns[chain][0]) < STRAIGHT_ON]
        straightest = min(straight, key=lambda chain: sum(map(abs, turns[chain])), default=None)
        manoeuvres = {}
        for chain in chains:
            side = turns[chain][0]
            if straightest is not None and chain in straight:
                side = 0.0 if ways[chain] == ways[straightest] else turns[chain][1] - turns[straightest][1]
            manoeuvres[chain] = SubTask.STRAIGHT if side == 0 else SubTask.RIGHT if side > 0 else SubTask.LEFT
        options = frozenset(manoeuvres.values())
        tasks |= {key: Task(manoeuvres[chain], options) for chain in chains for key in chain}
    return tasks


def _entries(graph: Graph[Chain], source: OpenDrive) -> dict[tuple[str, str, bool], list[Chain]]:
    """The lanes in each junction by the road, and the direction on it, that they come from."""
    found = defaultdict(list)
    for chain, before in graph.before.items():
        junction = source.roads[chain[0].road].junction
        if junction is not None and before and graph.after[chain]:
            found[(junction, *_way(source, before[0][-1]))].append(chain)
    return found


def _way(source: OpenDrive, key: LaneKey) -> Way:
    return key.road, forward(source.roads[key.road], key.lane)


def _turn(pieces: list[LanePiece]) -> tuple[float, float]:
    """By how much a lane's heading changes, and on which bearing its end lies from its start; to the right, rad."""
    (x, y), heading = pieces[-1].points[-1] - pieces[0].points[0], pieces[0].headings[0]
    bearing = math.remainder(math.atan2(y, x) - heading, math.tau)
    return sum(float(piece.headings[-1] - piece.headings[0]) for piece in pieces), bearing
