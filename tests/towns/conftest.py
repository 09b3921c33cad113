"""Small OpenDRIVE maps, written out as text."""

import math
from types import SimpleNamespace

import pytest

ENDS = {"start": "predecessor", "end": "successor"}


def geometry(s, x, y, hdg, length, shape="<line/>"):
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def lane(number, *widths, before=None, after=None, kind="driving"):
    """A lane whose widths are numbers or texts ``sOffset a b c d``; linked with lanes ``before`` and ``after``."""
    links = [f'<{tag} id="{k}"/>' for tag, k in (("predecessor", before), ("successor", after)) if k is not None]
    records = ""
    for width in widths or (4.0,):
        values = dict(
            zip(
                ("sOffset", *"abcd"), str(width).split() if isinstance(width, str) else (0, width, 0, 0, 0), strict=True
            )
        )
        records += "<width " + " ".join(f'{k}="{v}"' for k, v in values.items()) + "/>"
    return number, f'<lane id="{number}" type="{kind}"><link>{"".join(links)}</link>{records}</lane>'


def section(s, *lanes):
    sides = {"left": [x for k, x in lanes if k > 0], "right": [x for k, x in lanes if k < 0]}
    sides = {side: "".join(found) for side, found in sides.items() if found}
    return f'<laneSection s="{s}">' + "".join(f"<{k}>{x}</{k}>" for k, x in sides.items()) + "</laneSection>"


def road(number, length, geometries, sections, *, start=None, end=None, junction=-1, rule=None, offset=""):
    """A road; ``start`` and ``end`` say what is there: ``"road 3 end"`` or ``"junction 7"``."""
    links = ""
    for at, link in (("start", start), ("end", end)):
        if link is not None:
            kind, name, *contact = link.split()
            contact = f' contactPoint="{contact[0]}"' if contact else ""
            links += f'<{ENDS[at]} elementType="{kind}" elementId="{name}"{contact}/>'
    rule = f' rule="{rule}"' if rule else ""
    return (
        f'<road name="" length="{length}" id="{number}" junction="{junction}"{rule}><link>{links}</link>'
        f"<planView>{geometries}</planView><lanes>{offset}{sections}</lanes></road>"
    )


def connection(incoming, connecting, contact, *lanes):
    links = "".join(f'<laneLink from="{a}" to="{b}"/>' for a, b in lanes)
    return (
        f'<connection id="0" incomingRoad="{incoming}" connectingRoad="{connecting}" contactPoint="{contact}">'
        f"{links}</connection>"
    )


def junction(number, *connections):
    return f'<junction id="{number}" name="">{"".join(connections)}</junction>'


def opendrive(*elements, version="1.4"):
    major, minor = version.split(".")
    header = f'<header revMajor="{major}" revMinor="{minor}" north="0" south="0" east="0" west="0"/>'
    return "\n".join(['<?xml version="1.0"?>', "<OpenDRIVE>", header, *elements, "</OpenDRIVE>", ""])


def straight(number, x, y, hdg, length, *lanes, **options):
    """A straight road with one section."""
    return road(number, length, geometry(0, x, y, hdg, length), section(0, *lanes), **options)


def stadium(number, side, lanes, **options):
    """From (0, 10 side) to (200, 10 side) by way of y = 70 side: three lines, and two arcs of radius 20 around."""
    h, quarter, shape = side * math.pi / 2, 10 * math.pi, f'<arc curvature="{-side / 20}"/>'
    pieces = [
        (0, 10 * side, h, 40, "<line/>"),
        (0, 50 * side, h, quarter, shape),
        (20, 70 * side, 0, 160, "<line/>"),
        (180, 70 * side, 0, quarter, shape),
        (200, 50 * side, -h, 40, "<line/>"),
    ]
    text, s = "", 0.0
    for x, y, hdg, length, curve in pieces:
        text += geometry(s, x, y, hdg, length, curve)
        s += length
    return road(number, s, text, section(0, *lanes), **options)


def turn(number, name, x, y, hdg, degrees, side, start, end):
    """A connecting road: straight on for 20 m or a quarter circle of radius 10; its lane is on ``side``."""
    length = 20 if degrees == 0 else 5 * math.pi
    shape = "<line/>" if degrees == 0 else f'<arc curvature="{math.copysign(0.1, degrees)}"/>'
    entry, leave = (link.split() for link in (start, end))
    # Cars leave a road at its end on the lane of their side, at its start on the other one.
    lanes = side if entry[2] == "end" else -side, side if leave[2] == "start" else -side
    text = road(
        number,
        length,
        geometry(0, x, y, hdg, length, shape),
        section(0, lane(side, before=lanes[0], after=lanes[1])),
        start=start,
        end=end,
        junction=name,
        rule="LHT" if side > 0 else None,
    )
    return text, connection(entry[1], number, "start", (lanes[0], side))


def theta(side=-1):
    """Two T-junctions at (0, 0) and (200, 0), joined by three two-way streets of 4 m lanes: 1 by the north, 2 straight
    along y = 0, 3 by the south. Traffic keeps right for ``side`` -1, left for 1."""
    rule = "LHT" if side > 0 else None
    options = {"start": "junction 100", "end": "junction 200", "rule": rule}
    lanes = lane(1), lane(-1)
    streets = [stadium(1, 1, lanes, **options), straight(2, 10, 0, 0, 180, *lanes, **options)]
    streets.append(stadium(3, -1, lanes, **options))
    north, south, west, east = math.pi / 2, -math.pi / 2, math.pi, 0
    turns, junctions = [], []
    for name, at, x, inwards, way in ((100, "start", 0, west, 1), (200, "end", 200, east, -1)):
        ways = [
            (2, 1, x + 10 * way, 0, inwards, -90 * way),
            (2, 3, x + 10 * way, 0, inwards, 90 * way),
            (1, 3, x, 10, south, 0),
            (3, 1, x, -10, north, 0),
            (1, 2, x, 10, south, 90 * way),
            (3, 2, x, -10, north, -90 * way),
        ]
        made = [
            turn(name + k, name, px, py, hdg, degrees, side, f"road {a} {at}", f"road {b} {at}")
            for k, (a, b, px, py, hdg, degrees) in enumerate(ways)
        ]
        turns += [text for text, _ in made]
        junctions.append(junction(name, *(found for _, found in made)))
    return opendrive(*streets, *turns, *junctions)


@pytest.fixture(scope="session")
def xodr():
    """What writes OpenDRIVE."""
    functions = geometry, lane, section, road, connection, junction, opendrive, straight, stadium, turn, theta
    return SimpleNamespace(**{function.__name__: function for function in functions})


@pytest.fixture
def save(tmp_path):
    """Writes a map into a file."""

    def write(text, name="map.xodr"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write
