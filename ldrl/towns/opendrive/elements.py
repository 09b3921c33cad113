"""From XML elements of OpenDRIVE to checked records; what is written wrongly is a ``ValueError``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np

from ldrl.towns.opendrive.geometry import Clothoid, Geometry, Parametric
from ldrl.towns.opendrive.records import DRIVEN, Connection, Contact, LaneRecord, Link, Road, Section

__all__ = ["check_version", "connection", "road"]

MAX_LENGTH = 100_000.0
"""Longest road, and farthest from the origin that one may lie: float32 coordinates are 1 cm apart there, m."""
MAX_CURVATURE = 10.0
"""1/m."""
MAX_COEFFICIENT = 1e6
"""Of a polynomial; so none overflows."""
MAX_GAP = 1.0
"""How far a piece of a reference line may start from where the one before ends, m."""
VERSIONS = ((1, 4), (1, 5), (1, 6), (1, 7))
_ENDS: dict[Contact, str] = {"start": "predecessor", "end": "successor"}


def check_version(header: Element) -> None:
    """Refuse versions that cannot be read."""
    version = header.get("revMajor", "?"), header.get("revMinor", "?")
    if not all(part.isdecimal() for part in version) or tuple(map(int, version)) not in VERSIONS:
        raise ValueError(f"it is OpenDRIVE {version[0]:.9}.{version[1]:.9}; 1.4 to 1.7 can be read, so convert it")


def _number(element: Element, name: str, default: float | None = None, largest: float = math.inf) -> float:
    text = element.get(name, default)
    try:
        value = float("nan" if text is None else text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > largest:
        wanted = "a finite number" if largest == math.inf else f"a number from {-largest:g} to {largest:g}"
        raise ValueError(f"<{element.tag}> has {name}={text!s:.40}; give {wanted}")
    return value


def _length(element: Element, name: str, default: float | None = None) -> float:
    value = _number(element, name, default, MAX_LENGTH)
    if value < 0:
        raise ValueError(f"<{element.tag}> has {name}={value:g}; give a number from 0 to {MAX_LENGTH:g}")
    return value


def _records(elements: list[Element], start: str) -> np.ndarray:
    rows = [[_length(e, start, 0.0), *(_number(e, name, 0.0, MAX_COEFFICIENT) for name in "abcd")] for e in elements]
    return np.array(sorted(rows, key=lambda row: row[0]), np.float64).reshape(-1, 5)


def road(element: Element, name: str) -> Road:
    """The record of a ``<road>`` of that id."""
    length = _length(element, "length")
    if length == 0:
        raise ValueError("its length is 0; give its length in metres")
    junction = element.get("junction", "-1")
    links = {end: _link(e) for end, tag in _ENDS.items() if (e := element.find(f"link/{tag}")) is not None}
    bare = Road(name, length, None if junction in ("-1", "") else junction, links)
    if not any(lane.get("type") in DRIVEN for lane in element.iterfind("lanes/laneSection/*/lane")):
        return bare
    rule = element.get("rule", "RHT")
    if rule not in ("RHT", "LHT"):
        raise ValueError(f"its traffic rule is {rule:.40}; give RHT or LHT")
    offsets = _records(element.findall("lanes/laneOffset"), "s")
    sections = _sections(element.findall("lanes/laneSection"), length)
    line = _plan_view(element, length)
    return replace(bare, right_hand=rule == "RHT", geometries=line, offsets=offsets, sections=sections)


def _contact(element: Element) -> Contact:
    value = element.get("contactPoint")
    if value not in ("start", "end"):
        raise ValueError(f"<{element.tag}> has contactPoint={value!s:.40}; give start or end")
    return "start" if value == "start" else "end"


def _link(element: Element) -> Link:
    kind = element.get("elementType", "road")
    return Link(kind, element.get("elementId", ""), None if kind == "junction" else _contact(element))


def _plan_view(road: Element, length: float) -> tuple[Geometry, ...]:
    elements = [e for e in road.iterfind("planView/geometry") if _length(e, "length") > 0]
    geometries = sorted(map(_geometry, elements), key=lambda geometry: geometry.s)
    if not geometries or geometries[0].s > 0:
        raise ValueError("its planView has no <geometry> at s=0; add one")
    ends = [geometry.s for geometry in geometries[1:]] + [length]
    for geometry, end, following in zip(geometries, ends, [*geometries[1:], None], strict=True):
        if abs(geometry.s + geometry.curve.length - end) > MAX_GAP:
            reach = f"its <geometry> at s={geometry.s:g} reaches {geometry.s + geometry.curve.length:g}"
            raise ValueError(f"{reach} m, but the next one, or the road's end, is at {end:g} m; make them meet")
        if following is not None and (gap := _gap(geometry, following)) > MAX_GAP:
            raise ValueError(f"its <geometry> at s={end:g} is {gap:.1f} m from the end of the one before; join them")
    return tuple(geometries)


def _gap(geometry: Geometry, following: Geometry) -> float:
    # In steps short enough for the quadrature of a tight spiral.
    u, v, _ = geometry.curve.poses(np.linspace(0, geometry.curve.length, math.ceil(4 * geometry.curve.length) + 2))
    cos, sin = math.cos(geometry.heading), math.sin(geometry.heading)
    end = geometry.x + u[-1] * cos - v[-1] * sin, geometry.y + u[-1] * sin + v[-1] * cos
    return math.dist(end, (following.x, following.y))


def _geometry(element: Element) -> Geometry:
    shapes = {child.tag: child for child in element}
    if len(shapes) != 1 or (tag := next(iter(shapes))) not in _CURVES:
        raise ValueError(f"a <geometry> has {sorted(shapes)!s:.80}; give it one of {', '.join(_CURVES)}")
    x, y = (_number(element, name, largest=MAX_LENGTH) for name in "xy")
    curve = _CURVES[tag](shapes[tag], _length(element, "length"))
    return Geometry(_length(element, "s"), x, y, _number(element, "hdg", largest=1e3), curve)


def _arc(element: Element, length: float) -> Clothoid:
    curvature = _number(element, "curvature", largest=MAX_CURVATURE)
    return Clothoid(length, curvature, curvature)


def _spiral(element: Element, length: float) -> Clothoid:
    return Clothoid(length, *(_number(element, name, largest=MAX_CURVATURE) for name in ("curvStart", "curvEnd")))


def _coefficients(element: Element, names: Iterable[str]) -> list[float]:
    return [_number(element, name, largest=MAX_COEFFICIENT) for name in names]


def _poly3(element: Element, length: float) -> Parametric:
    return Parametric(length, (0.0, 1.0), _coefficients(element, "abcd"), None)


def _param_poly3(element: Element, length: float) -> Parametric:
    span = element.get("pRange", "normalized")
    if span not in ("normalized", "arcLength"):
        raise ValueError(f"<paramPoly3> has pRange={span:.40}; give normalized or arcLength")
    u, v = (_coefficients(element, [f"{name}{axis}" for name in "abcd"]) for axis in "UV")
    return Parametric(length, u, v, 1.0 if span == "normalized" else length)


_CURVES: Mapping[str, Callable[[Element, float], Clothoid | Parametric]] = {
    "line": lambda _, length: Clothoid(length),
    "arc": _arc,
    "spiral": _spiral,
    "poly3": _poly3,
    "paramPoly3": _param_poly3,
}


def _sections(elements: list[Element], length: float) -> tuple[Section, ...]:
    if any(element.get("singleSide", "false") in ("true", "1") for element in elements):
        raise ValueError("a <laneSection> is singleSide; list the lanes of both sides in each section")
    elements = sorted(elements, key=lambda element: _length(element, "s"))
    starts = [_length(element, "s") for element in elements]
    if starts[0] > 0 or starts[-1] > length:
        found = f"its lane sections start at {starts[0]:g} to {starts[-1]:g} m"
        raise ValueError(f"{found}; let the first start at 0 and the last before {length:g}")
    ends = [*starts[1:], length]
    return tuple(Section(s, end, _lanes(e)) for s, end, e in zip(starts, ends, elements, strict=True))


def _lanes(section: Element) -> dict[int, LaneRecord]:
    lanes = {}
    for element in section.iterfind("*/lane"):
        number = int(_number(element, "id", largest=1000))
        if element.find("border") is not None:
            raise ValueError(f"lane {number} is given by <border>; give its <width>")
        widths = _records(element.findall("width"), "sOffset")
        if element.get("type") in DRIVEN and not len(widths):
            raise ValueError(f"lane {number} has no <width>; give one")
        links = (tuple(int(_number(e, "id")) for e in element.iterfind(f"link/{tag}")) for tag in _ENDS.values())
        lanes[number] = LaneRecord(number, element.get("type", "none"), widths, *links)
    return lanes


def connection(element: Element) -> Connection:
    """The record of a ``<connection>`` of a junction."""
    connecting = element.get("connectingRoad", element.get("linkedRoad", ""))
    lanes = tuple((int(_number(e, "from")), int(_number(e, "to"))) for e in element.iterfind("laneLink"))
    return Connection(element.get("incomingRoad", ""), connecting, _contact(element), lanes)
