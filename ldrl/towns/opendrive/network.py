"""From an OpenDRIVE file to a highway-env road network whose lanes know their manoeuvre."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from highway_env.road.lane import LineType
from highway_env.road.road import RoadNetwork

from ldrl.towns.opendrive.graph import Chain, Graph, chains, merge
from ldrl.towns.opendrive.junctions import FOLLOW, Task, classify, leave_out_u_turns
from ldrl.towns.opendrive.lanes import LaneKey, LanePiece, sample_road
from ldrl.towns.opendrive.links import link_lanes
from ldrl.towns.opendrive.reader import read_opendrive
from ldrl.towns.opendrive.records import OpenDrive
from ldrl.towns.polyline import PolylineLane
from ldrl.towns.surface import raster_size

__all__ = ["load_network"]

MAX_TOTAL = 1_000_000.0
"""Length of all lanes of whatever type, m."""
MAX_LANES = 32_767
"""What a route window of 16-bit integers can name."""
MOST_NAMED = 20
"""Problems that a message names."""


def load_network(path: str | Path) -> RoadNetwork:
    """Make a road network of an OpenDRIVE file, version 1.4 to 1.7.

    *Which lanes*: those for cars in one direction, of the types ``driving``, ``entry``, ``exit``, ``onRamp``,
    ``offRamp``, ``connectingRamp`` and ``slipLane``; all others (``bidirectional`` too) are no road. Of these every
    lane is left out, repeatedly, that leads nowhere or that nothing leads to, because routes go on for ever and stay
    in their lanes. A warning names what is left out, and broken links. What is written wrongly, or cannot be read,
    fails the load as a whole: so do lanes given by ``border``, ``singleSide`` sections and versions from 1.8.

    *Which direction*: by each road's ``rule``, RHT or LHT, right-hand traffic without.

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
        pieces = _sample(source)
        links, problems = link_lanes(source, pieces)
        junction_of = {key: source.roads[key.road].junction for key in pieces}
        graph = merge(chains(links), lambda a, b: junction_of[a[-1]] == junction_of[b[0]])
        leave_out_u_turns(graph, source, pieces)
        left_out = _leave_out_dead_ends(graph)
        problems += [f"nothing leads on from, or to, {' and '.join(map(str, chain))}" for chain in left_out]
        more = len(problems) - MOST_NAMED
        summary = "; ".join(problems[:MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")
        if not graph.after:
            raise ValueError(f"no lane leads on for ever; join its roads into loops: {summary}")
        tasks = classify(graph, source, pieces)
        graph = merge(graph, lambda a, b: a[-1] not in tasks and b[0] not in tasks)
        network = _network(graph, pieces, tasks)
    except ValueError as error:
        raise ValueError(f"map {path}: {error}") from None
    if problems:
        warnings.warn(f"map {path}: left out what cannot be driven for ever: {summary}", stacklevel=3)
    return network


def _sample(source: OpenDrive) -> dict[LaneKey, LanePiece]:
    """Samples of all lanes for cars."""
    roads = [road for road in source.roads.values() if road.sections]
    total = sum((section.end - section.start) * len(section.lanes) for road in roads for section in road.sections)
    if total > MAX_TOTAL:
        raise ValueError(
            f"its lanes are {total / 1000:.0f} km long, the limit is {MAX_TOTAL / 1000:g}; cut it into parts"
        )
    pieces = {key: piece for road in roads for key, piece in sample_road(road).items()}
    if not pieces:
        raise ValueError("it has no lane for cars; give one with lanes of type 'driving'")
    corners = np.array([(piece.points.min(0), piece.points.max(0)) for piece in pieces.values()])
    raster_size(np.ptp(corners.reshape(-1, 2), axis=0))  # sooner than after all other work
    return pieces


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


def _network(graph: Graph[Chain], pieces: dict[LaneKey, LanePiece], tasks: dict[LaneKey, Task]) -> RoadNetwork:
    """A network in which a node is where lanes end that the same lanes follow.

    A lane that follows at several nodes, because it shares only some of them with others, is an edge from each.
    """
    network = RoadNetwork()
    nodes: dict[frozenset[Chain], str] = {}
    for chain, after in graph.after.items():
        nodes.setdefault(frozenset(after), f"end of {chain[-1]}")
    for chain, before in graph.before.items():
        task = tasks.get(chain[0], FOLLOW)
        lane = _lane([pieces[key] for key in chain], task)
        for start in dict.fromkeys(nodes[frozenset(graph.after[preceding])] for preceding in before):
            network.add_lane(start, nodes[frozenset(graph.after[chain])], lane)
    if len(network.lanes_list()) > MAX_LANES:
        raise ValueError(f"it has {len(network.lanes_list())} lanes, the limit is {MAX_LANES}; cut it into parts")
    return network


def _lane(pieces: list[LanePiece], task: Task) -> PolylineLane:
    """One lane of pieces that follow each other."""
    points, headings, widths = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("points", "headings", "widths")
    )
    lines = (LineType.STRIPED, LineType.CONTINUOUS) if task is FOLLOW else (LineType.NONE, LineType.NONE)
    lane = PolylineLane(points, headings, widths, lines)
    lane.manoeuvre, lane.options = task
    return lane
