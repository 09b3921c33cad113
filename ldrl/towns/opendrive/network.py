"""From an OpenDRIVE file to a highway-env road network whose lanes know their manoeuvre."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from highway_env.road.lane import LineType
from highway_env.road.road import RoadNetwork

from ldrl.subtasks import SubTask
from ldrl.towns.opendrive.graph import Chain, Graph, chains, merge
from ldrl.towns.opendrive.junctions import classify, leave_out_u_turns
from ldrl.towns.opendrive.lanes import LaneKey, LanePiece, sample_road
from ldrl.towns.opendrive.links import link_lanes
from ldrl.towns.opendrive.reader import read_opendrive
from ldrl.towns.polyline import PolylineLane

__all__ = ["load_network"]

MAX_TOTAL = 300_000.0
"""Length of all lanes, m."""
MAX_LANES = 32_767
"""What a route window of 16-bit integers can name."""
NEAR = 0.1
"""Where samples of two lanes that become one are closer, one of them is dropped, m."""
MOST_NAMED = 20
"""Problems that a message names."""


def load_network(path: str | Path) -> RoadNetwork:
    """Make a road network of an OpenDRIVE file, version 1.4 to 1.7.

    *Which lanes*: those for cars in one direction, of the types ``driving``, ``entry``, ``exit``, ``onRamp``,
    ``offRamp``, ``connectingRamp`` and ``slipLane``; all others (``bidirectional`` too) are no road. Of these every
    lane is left out, repeatedly, that leads nowhere or that nothing leads to, because routes go on for ever and stay
    in their lanes. A warning names what is left out, and broken links. What is written wrongly, or cannot be read,
    fails the load as a whole.

    *Which manoeuvre*: see :func:`~ldrl.towns.opendrive.junctions.classify`.

    *Which pieces*: lanes that follow each other without a branch become one, apart from those of junctions.

    Args:
        path: the file.

    Returns:
        A new network; each lane has the attribute ``manoeuvre``, a :class:`~ldrl.subtasks.SubTask`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: no network can be made of it; the message names the road and the remedy.
    """
    source = read_opendrive(path)
    try:
        pieces = {key: piece for road in source.roads.values() if road.sections for key, piece in sample_road(road).items()}
    except ValueError as error:
        raise ValueError(f"map {path}: {error}") from None
    if not pieces:
        raise ValueError(f"map {path} has no lane for cars; give one with lanes of type 'driving'")
    links, problems = link_lanes(source, pieces)
    junction_of = {key: source.roads[key.road].junction for key in pieces}
    graph = merge(chains(links), lambda a, b: junction_of[a[-1]] == junction_of[b[0]])
    leave_out_u_turns(graph, source)
    problems += [f"no way on from, or to, {' and '.join(map(str, chain))}" for chain in _leave_out_dead_ends(graph)]
    summary = "; ".join(problems[:MOST_NAMED]) + f"; and {len(problems) - MOST_NAMED} more" * (
        len(problems) > MOST_NAMED
    )
    if not graph.after:
        raise ValueError(f"map {path}: no lane leads on for ever; join its roads into loops: {summary}")
    if problems:
        warnings.warn(f"map {path}: what cannot be driven for ever is left out: {summary}", stacklevel=3)
    manoeuvres = classify(graph, source, pieces)
    following = {key for chain, manoeuvre in manoeuvres.items() if manoeuvre == SubTask.LANEFOLLOW for key in chain}
    graph = merge(graph, lambda a, b: a[-1] in following and b[0] in following)
    return _network(graph, pieces, {chain[0]: manoeuvre for chain, manoeuvre in manoeuvres.items()})


def _leave_out_dead_ends(graph: Graph[Chain]) -> list[Chain]:
    """Remove lanes that lead nowhere or that nothing leads to, until there is none; return them."""
    removed = []
    doubtful = list(graph.after)
    while doubtful:
        chain = doubtful.pop()
        if chain in graph.after and not (graph.after[chain] and graph.before[chain]):
            doubtful += graph.after[chain] + graph.before[chain]
            graph.remove(chain)
            removed.append(chain)
    return removed


def _network(
    graph: Graph[Chain], pieces: dict[LaneKey, LanePiece], manoeuvres: dict[LaneKey, SubTask]
) -> RoadNetwork:
    """A network in which a node is where the lanes end that the same lanes follow.

    A lane that follows at several nodes, because it shares only some of them with others, is an edge from each.
    """
    network = RoadNetwork()
    nodes: dict[frozenset[Chain], str] = {}
    for chain, after in graph.after.items():
        nodes.setdefault(frozenset(after), f"end of {chain[-1]}")
    for chain, before in graph.before.items():
        lane = _lane([pieces[key] for key in chain], manoeuvres[chain[0]])
        for start in dict.fromkeys(nodes[frozenset(graph.after[preceding])] for preceding in before):
            network.add_lane(start, nodes[frozenset(graph.after[chain])], lane)
    return network


def _lane(pieces: list[LanePiece], manoeuvre: SubTask) -> PolylineLane:
    """One lane of pieces that follow each other."""
    kept = [
        slice(0, -1 if np.hypot(*(after.points[0] - piece.points[-1])) < NEAR else None)
        for piece, after in zip(pieces[:-1], pieces[1:], strict=True)
    ] + [slice(None)]
    samples = [
        np.concatenate([values[part] for values, part in zip(each, kept, strict=True)])
        for each in (
            [piece.points for piece in pieces],
            [piece.headings for piece in pieces],
            [piece.widths for piece in pieces],
        )
    ]
    on_street = manoeuvre == SubTask.LANEFOLLOW
    lines = (LineType.STRIPED, LineType.CONTINUOUS) if on_street else (LineType.NONE, LineType.NONE)
    lane = PolylineLane(*samples, line_types=lines)
    lane.manoeuvre = manoeuvre
    return lane
