"""What a road network needs of an OpenDRIVE file, as plain records in the file's own frame.

Metres and radians, x east, y **north**, headings counter-clockwise; s runs along a road's reference line and t to its
left. Lanes left of the line have positive ids, those right of it negative ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from ldrl.towns.opendrive.geometry import Geometry

__all__ = ["DRIVEN", "Connection", "Contact", "LaneRecord", "Link", "OpenDrive", "Road", "Section"]

DRIVEN = frozenset(
    ("driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "mwyEntry", "mwyExit")
)
"""Lane types for cars that have one direction. Not among them: ``bidirectional``, lanes for buses, taxis or parking."""

Contact = Literal["start", "end"]


class Link(NamedTuple):
    """What a road leads to at one of its ends; ``contact`` is None for a junction."""

    kind: str
    id: str
    contact: Contact | None


@dataclass(frozen=True)
class LaneRecord:
    """A lane of a section: its type, ids of the lanes it is linked with, and widths ``[K, 5]`` (see ``cubic``)."""

    id: int
    type: str
    widths: np.ndarray
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]


@dataclass(frozen=True)
class Section:
    """The lanes by id between two arc lengths of a road, m."""

    start: float
    end: float
    lanes: Mapping[int, LaneRecord]


@dataclass(frozen=True)
class Road:
    """A road; one without driven lanes keeps neither geometry nor sections.

    Args:
        id: the file's.
        length: m.
        junction: of which it is a connecting road, or None.
        links: what it leads to at its start and at its end.
        right_hand: whether traffic keeps right.
        geometries: of the reference line.
        offsets: of the lanes from it, ``[K, 5]`` (see ``cubic``), positive to the left, m.
        sections: in order.
    """

    id: str
    length: float
    junction: str | None
    links: Mapping[Contact, Link]
    right_hand: bool = True
    geometries: tuple[Geometry, ...] = ()
    offsets: np.ndarray = field(default_factory=lambda: np.empty((0, 5)))
    sections: tuple[Section, ...] = ()


class Connection(NamedTuple):
    """Lanes ``(from, to)`` that lead from an incoming road to an end of another road, in a junction."""

    incoming: str
    connecting: str
    contact: Contact
    lanes: tuple[tuple[int, int], ...]


class OpenDrive(NamedTuple):
    """Roads by id, and the connections of each junction by its id."""

    roads: dict[str, Road]
    junctions: dict[str, tuple[Connection, ...]]
