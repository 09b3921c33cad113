"""Centre lines of a road's driven lanes, section by section."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ldrl.towns.opendrive.geometry import cubic, reference_line
from ldrl.towns.opendrive.records import DRIVEN, Road, Section

__all__ = ["LaneKey", "LanePiece", "forward", "sample_road"]

STEP = 0.25
"""Largest distance between two samples of a reference line, m."""
SHORTEST = 0.01
"""Shorter sections are passed over, m."""
NARROW = 0.5
"""A lane opens or closes where it is narrower, and is none where it is nowhere wider, m."""
MAX_WIDTH = 30.0
"""m."""
MAX_COORDINATE = 110_000.0
"""Where a road may reach, m."""


class LaneKey(NamedTuple):
    """A lane in a section of a road."""

    road: str
    section: int
    lane: int

    def __str__(self) -> str:
        return f"road {self.road} section {self.section} lane {self.lane}"


@dataclass
class LanePiece:
    """A lane's samples in driving direction and in ldrl's frame: y south, headings clockwise.

    Args:
        points: ``[N, 2]``, m.
        headings: ``[N]``, rad.
        widths: ``[N]``, m.
        opens_beside: the lane beside it from which cars come where it begins without width.
        closes_beside: the lane beside it to which cars go where it ends without width.
    """

    points: np.ndarray
    headings: np.ndarray
    widths: np.ndarray
    opens_beside: LaneKey | None = None
    closes_beside: LaneKey | None = None


def forward(road: Road, lane: int) -> bool:
    """Whether cars drive on a lane in the direction of growing s."""
    return (lane < 0) == road.right_hand


def sample_road(road: Road) -> dict[LaneKey, LanePiece]:
    """Sample a road's driven lanes, except where they have next to no width or their section next to no length.

    A lane that opens from no width, or closes, does so beside another: there its centre line is led over from, or to,
    the other's, as far as it is open, and its width reaches to its true outer edge. So a route can follow it.

    Raises:
        ValueError: a lane is too wide or lies too far away.
    """
    pieces: dict[LaneKey, LanePiece] = {}
    stations = [
        np.linspace(section.start, section.end, max(2, math.ceil((section.end - section.start) / STEP)) + 1)
        for section in road.sections
    ]
    every = np.unique(np.concatenate(stations))
    line = np.stack(reference_line(road.geometries, every))
    for index, (section, s) in enumerate(zip(road.sections, stations, strict=True)):
        if section.end - section.start >= SHORTEST:
            here = np.searchsorted(every, s)
            pieces |= _sample_section(road, index, section, s, line[:, here])
    for key, piece in pieces.items():
        if not (np.abs(piece.points) < MAX_COORDINATE).all() or not (piece.widths < MAX_WIDTH).all():
            reach, width = np.abs(piece.points).max(), piece.widths.max()
            limits = f"at most {MAX_COORDINATE / 1000:g} km and {MAX_WIDTH:g} m"
            raise ValueError(f"{key} lies {reach:g} m from the origin and is {width:g} m wide; {limits} are allowed")
    return pieces


def _sample_section(
    road: Road, index: int, section: Section, s: np.ndarray, line: np.ndarray
) -> dict[LaneKey, LanePiece]:
    offset = cubic(road.offsets, s)
    centres, widths = _cross_section(section, offset, s)
    pieces = {}
    for lane in centres:
        centre, width = centres[lane], widths[lane]
        if section.lanes[lane].type not in DRIVEN or width.max() <= NARROW:
            continue
        opens, closes = width[0] < NARROW, width[-1] < NARROW
        beside = _beside(lane, widths, section) if opens or closes else None
        if beside is not None:
            centre, width = _lead_over(centre, width, centres[beside], opens, closes)
        key = LaneKey(road.id, index, beside) if beside is not None else None
        ends = [key if end else None for end in (opens, closes)]
        pieces[LaneKey(road.id, index, lane)] = _piece(line, s, centre, width, forward(road, lane), ends)
    return pieces


def _cross_section(
    section: Section, offset: np.ndarray, s: np.ndarray
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """By id, the t of every lane's centre and its width, m."""
    centres, widths = {}, {}
    for side in (1, -1):
        inner = offset
        for lane in sorted((lane for lane in section.lanes if lane * side > 0), key=abs):
            widths[lane] = cubic(section.lanes[lane].widths, s - section.start).clip(0)
            centres[lane] = inner + side * widths[lane] / 2
            inner = inner + side * widths[lane]
    return centres, widths


def _beside(lane: int, widths: dict[int, np.ndarray], section: Section) -> int | None:
    """The lane beside one that opens or closes: the inner neighbour, or else the outer one."""
    side = 1 if lane > 0 else -1
    for neighbour in (lane - side, lane + side):
        if neighbour in widths and section.lanes[neighbour].type in DRIVEN and widths[neighbour].min() > NARROW:
            return neighbour
    return None


def _lead_over(
    centre: np.ndarray, width: np.ndarray, beside: np.ndarray, opens: bool, closes: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Centre and width of a lane that is led over from or to the one beside it."""
    part = np.ones_like(width)
    if opens:
        part = np.maximum.accumulate(width) / width.max()
    if closes:
        part = part * np.maximum.accumulate(width[::-1])[::-1] / width.max()
    led = beside + part * (centre - beside)
    return led, width + 2 * np.abs(centre - led)


def _piece(
    line: np.ndarray, s: np.ndarray, centre: np.ndarray, width: np.ndarray, ahead: bool, beside: list[LaneKey | None]
) -> LanePiece:
    x, y, heading = line
    curvature = np.gradient(heading, s, edge_order=2)
    slope = np.gradient(centre, s, edge_order=2)
    points = np.stack((x - centre * np.sin(heading), y + centre * np.cos(heading)), -1)
    heading = heading + np.arctan2(slope, 1 - curvature * centre)
    if not ahead:
        points, heading, width, beside = points[::-1], heading[::-1] + math.pi, width[::-1], beside[::-1]
    # The one place where OpenDRIVE's frame becomes ldrl's.
    return LanePiece(points * (1.0, -1.0), -heading, width, *beside)
