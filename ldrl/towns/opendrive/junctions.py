"""What there is to do at junctions."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from ldrl.subtasks import SubTask
from ldrl.towns.opendrive.graph import Chain, Graph
from ldrl.towns.opendrive.lanes import LaneKey, LanePiece, forward
from ldrl.towns.opendrive.records import OpenDrive

__all__ = ["classify", "leave_out_u_turns"]

STRAIGHT_ON = math.radians(30)
"""A junction lane that turns less leads straight on."""

Way = tuple[str, bool]
"""A road, and whether it is driven forward."""


def leave_out_u_turns(graph: Graph[Chain], source: OpenDrive) -> None:
    """Remove junction lanes back onto the road that they come from, where that road has another way on."""
    for (_, road, ahead), chains in _entries(graph, source).items():
        back = [chain for chain in chains if _way(source, graph.after[chain][0][0]) == (road, not ahead)]
        if len(back) < len(chains):
            for chain in back:
                graph.remove(chain)


def classify(graph: Graph[Chain], source: OpenDrive, pieces: dict[LaneKey, LanePiece]) -> dict[Chain, SubTask]:
    """The manoeuvre of every lane.

    A lane outside junctions is ``LANEFOLLOW``; so is one inside if the road that it comes from leads to one road only,
    because there is nothing to say about it, as at a corner. Else a lane that turns by less than 30 degrees is
    ``STRAIGHT``, others ``LEFT`` or ``RIGHT``. Where several roads lie straight on, the straightest is ``STRAIGHT``
    and the others are ``LEFT`` or ``RIGHT``, on whichever side of it they lie.

    Args:
        graph: all lanes, each with one before and one after it.
        source: the file.
        pieces: samples of its lanes.
    """
    manoeuvres = dict.fromkeys(graph.after, SubTask.LANEFOLLOW)
    for chains in _entries(graph, source).values():
        ways = {chain: _way(source, graph.after[chain][0][0]) for chain in chains}
        if len(set(ways.values())) == 1:
            continue
        turns = {chain: _turn([pieces[key] for key in chain]) for chain in chains}
        straight = [chain for chain in chains if abs(turns[chain][0]) < STRAIGHT_ON]
        straightest = min(straight, key=lambda chain: sum(map(abs, turns[chain])), default=None)
        for chain in chains:
            side = turns[chain][0]
            if straightest is not None and chain in straight:
                side = 0.0 if ways[chain] == ways[straightest] else turns[chain][1] - turns[straightest][1]
            manoeuvres[chain] = SubTask.STRAIGHT if side == 0 else SubTask.RIGHT if side > 0 else SubTask.LEFT
    return manoeuvres


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
