"""Which lane leads to which, from the links that roads, lanes and junctions declare."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ldrl.towns.opendrive.graph import Graph
from ldrl.towns.opendrive.lanes import LaneKey, LanePiece, forward
from ldrl.towns.opendrive.records import DRIVEN, Contact, OpenDrive, Road

__all__ = ["link_lanes"]

MAX_GAP = 2.0
"""How far a lane may begin from the end of the one before, m."""


class _End(NamedTuple):
    """An end of a lane; which of its two, in the direction of s."""

    key: LaneKey
    at: Contact


def link_lanes(source: OpenDrive, pieces: dict[LaneKey, LanePiece]) -> tuple[Graph[LaneKey], list[str]]:
    """Link lanes as the file says.

    A link counts whichever of its two lanes declares it. Lanes without a piece are passed over: those before lead
    straight to those after. A lane that opens or closes beside another, and is linked with nothing there, shares what
    comes before, or after, the other.

    Args:
        source: the file.
        pieces: samples of its driven lanes.

    Returns:
        The links between the pieces' lanes, and what is broken in the file, in words that name the road.
    """
    graph: Graph[LaneKey] = Graph()
    broken: list[str] = []
    for road in source.roads.values():
        for key in _driven(road):
            graph.add(key)
    for road in source.roads.values():
        for key in _driven(road):
            for at in ("start", "end"):
                _join_declared(source, graph, _End(key, at), broken)
    _join_junctions(source, graph, broken)
    _pass_over(graph, pieces)
    _cut_gaps(graph, pieces, broken)
    _share_beside(graph, pieces)
    return graph, broken


def _driven(road: Road) -> Iterator[LaneKey]:
    for i, section in enumerate(road.sections):
        for lane, record in section.lanes.items():
            if record.type in DRIVEN:
                yield LaneKey(road.id, i, lane)


def _join(source: OpenDrive, graph: Graph[LaneKey], a: _End, b: _End) -> None:
    """Join two ends, if cars leave one lane there and enter the other."""
    if a.key in graph.after and b.key in graph.after:
        leaves = [forward(source.roads[end.key.road], end.key.lane) == (end.at == "end") for end in (a, b)]
        if leaves == [True, False]:
            graph.join(a.key, b.key)
        elif leaves == [False, True]:
            graph.join(b.key, a.key)


def _join_declared(source: OpenDrive, graph: Graph[LaneKey], end: _End, broken: list[str]) -> None:
    """Join one end of a lane with what the lane and its road declare there."""
    (name, index, lane), at = end
    road = source.roads[name]
    record = road.sections[index].lanes[lane]
    inner = index + (1 if at == "end" else -1)
    if 0 <= inner < len(road.sections):
        other, contact, section = road, _opposite(at), inner
    else:
        link = road.links.get(at)
        if link is None or link.kind == "junction":
            return
        if link.id not in source.roads:
            broken.append(f"{end.key} leads to road {link.id!r}, which does not exist")
            return
        other, contact = source.roads[link.id], link.contact or "start"
        section = 0 if contact == "start" else len(other.sections) - 1
    for linked in record.predecessors if at == "start" else record.successors:
        if other.sections and linked not in other.sections[section].lanes:
            broken.append(f"{end.key} is linked with lane {linked} of road {other.id}, which does not exist")
        _join(source, graph, end, _End(LaneKey(other.id, section, linked), contact))


def _opposite(at: Contact) -> Contact:
    return "start" if at == "end" else "end"


def _join_junctions(source: OpenDrive, graph: Graph[LaneKey], broken: list[str]) -> None:
    for junction, connections in source.junctions.items():
        for connection in connections:
            unknown = [name for name in (connection.incoming, connection.connecting) if name not in source.roads]
            if unknown:
                broken.append(f"junction {junction} connects road {unknown[0]!r}, which does not exist")
                continue
            incoming, connecting = source.roads[connection.incoming], source.roads[connection.connecting]
            section = 0 if connection.contact == "start" else len(connecting.sections) - 1
            for at, link in incoming.links.items():
                if link.kind != "junction" or link.id != junction:
                    continue
                last = 0 if at == "start" else len(incoming.sections) - 1
                for a, b in connection.lanes:
                    entry = _End(LaneKey(connecting.id, section, b), connection.contact)
                    _join(source, graph, _End(LaneKey(incoming.id, last, a), at), entry)


def _pass_over(graph: Graph[LaneKey], pieces: dict[LaneKey, LanePiece]) -> None:
    for key in [key for key in graph.after if key not in pieces]:
        for a in graph.before[key]:
            for b in graph.after[key]:
                graph.join(a, b)
        graph.remove(key)


def _cut_gaps(graph: Graph[LaneKey], pieces: dict[LaneKey, LanePiece], broken: list[str]) -> None:
    for a, following in graph.after.items():
        for b in list(following):
            gap = float(np.hypot(*(pieces[b].points[0] - pieces[a].points[-1])))
            if gap > MAX_GAP:
                graph.cut(a, b)
                broken.append(f"{a} ends {gap:.1f} m from {b}, which is to follow it")


def _share_beside(graph: Graph[LaneKey], pieces: dict[LaneKey, LanePiece]) -> None:
    for key, piece in pieces.items():
        if piece.opens_beside is not None and not graph.before[key]:
            for preceding in graph.before[piece.opens_beside]:
                graph.join(preceding, key)
        if piece.closes_beside is not None and not graph.after[key]:
            for following in graph.after[piece.closes_beside]:
                graph.join(key, following)
