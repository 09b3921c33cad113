"""Reading OpenDRIVE files: what is in them, and every way in which they can be bad."""

import math
import tracemalloc

import pytest

from ldrl.towns import Town
from ldrl.towns.opendrive.reader import read_opendrive

LINE = '<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>'
BOMB = '<?xml version="1.0"?><!DOCTYPE OpenDRIVE [<!ENTITY a "0123456789">' + "".join(
    f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(12)
)


def test_what_is_in_a_file(xodr, save):
    shape = '<spiral curvStart="0" curvEnd="0.1"/>'
    lanes = [
        xodr.section(0, xodr.lane(2, kind="sidewalk"), xodr.lane(1), xodr.lane(-1, 3.5, "10 3 0.5 0 0", after=-1)),
        xodr.section(30, xodr.lane(-1, before=-1)),
    ]
    offset = '<laneOffset s="0" a="1" b="0" c="0" d="0"/>'
    road = xodr.road(
        "7a",
        50,
        xodr.geometry(0, 1, 2, 3, 50, shape),
        "".join(lanes),
        start="road 8 end",
        end="junction 9",
        offset=offset,
    )
    other = xodr.road(8, 5, "", xodr.section(0, xodr.lane(1, kind="sidewalk")), junction=9)
    source = read_opendrive(
        save(xodr.opendrive(road, other, xodr.junction(9, xodr.connection("7a", 8, "end", (-1, 2)))))
    )
    road = source.roads["7a"]
    assert (road.length, road.junction, road.right_hand) == (50, None, True)
    assert road.links["start"] == ("road", "8", "end")
    assert road.links["end"] == ("junction", "9", None)
    geometry = road.geometries[0]
    assert (geometry.x, geometry.y, geometry.heading) == (1, 2, 3)
    assert (geometry.curve.start, geometry.curve.end) == (0, 0.1)
    assert road.offsets.tolist() == [[0, 1, 0, 0, 0]]
    first, second = road.sections
    assert (first.start, first.end, second.end) == (0, 30, 50)
    assert {k: lane.type for k, lane in first.lanes.items()} == {1: "driving", 2: "sidewalk", -1: "driving"}
    assert first.lanes[-1].widths.tolist() == [[0, 3.5, 0, 0, 0], [10, 3, 0.5, 0, 0]]
    assert (first.lanes[-1].successors, second.lanes[-1].predecessors) == ((-1,), (-1,))
    assert source.roads["8"].junction == "9"
    assert not source.roads["8"].sections  # nobody drives there
    assert source.junctions["9"] == (("7a", "8", "end", ((-1, 2),)),)


@pytest.mark.parametrize("version", ["1.4", "1.5", "1.6", "1.7"])
def test_versions_that_can_be_read(version, xodr, save):
    assert not read_opendrive(save(xodr.opendrive(version=version))).roads


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no XML, or cut off .*; give a whole OpenDRIVE file"),
        ("Town 1\n", "is no XML, or cut off"),
        ("\0\1\2", "is no XML, or cut off"),
        ('<?xml version="1.0" encoding="klingon"?><OpenDRIVE/>', "is no XML, or cut off"),
        ("<osm/>", "its root is <osm>, not <OpenDRIVE>; give an OpenDRIVE file"),
        ("<OpenDRIVE><road/></OpenDRIVE>", "it has no <header> with revMajor and revMinor before its roads; add one"),
        ('<OpenDRIVE><header revMajor="1" revMinor="8"/></OpenDRIVE>', "it is OpenDRIVE 1.8; 1.4 to 1.7 can be read"),
        ('<OpenDRIVE><header revMajor="1" revMinor="1"/></OpenDRIVE>', "it is OpenDRIVE 1.1; 1.4 to 1.7 can be read"),
        ('<OpenDRIVE><header revMajor="x"/></OpenDRIVE>', r"it is OpenDRIVE x\.\?; 1.4 to 1.7 can be read"),
        (BOMB + "]><OpenDRIVE>&m;</OpenDRIVE>", "it declares a document type.*; remove the <!DOCTYPE"),
        ('<!DOCTYPE OpenDRIVE SYSTEM "file:///etc/hostname"><OpenDRIVE/>', "it declares a document type"),
    ],
)
def test_files_that_are_no_maps(text, message, save):
    with pytest.raises(ValueError, match=rf"map .*map\.xodr:? {message}"):
        Town.load(save(text))


def test_a_truncated_file(xodr, save):
    text = xodr.theta()
    for share in (0.1, 0.5, 0.99):
        with pytest.raises(ValueError, match="is no XML, or cut off"):
            Town.load(save(text[: int(share * len(text))]))


def test_missing_files(tmp_path):
    for path in (tmp_path / "none.xodr", tmp_path):
        with pytest.raises(FileNotFoundError, match=r"there is no map .*; give an OpenDRIVE file"):
            read_opendrive(path)


def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / "huge.xodr"
    with path.open("wb") as file:
        file.truncate(100_000_000)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"huge\.xodr has 100 MB, the limit is 50; cut it into parts"):
        Town.load(path)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_what_is_not_needed_takes_no_memory(xodr, save):
    path = save(xodr.opendrive("<userData>" + "<x><y z='1'/>text</x>" * 50_000 + "</userData>"))
    tracemalloc.start()
    read_opendrive(path)
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('length="50" id', 'length="nan" id', "<road> has length=nan; give a number from -100000 to 100000"),
        ('length="50" id', 'length="inf" id', "<road> has length=inf; give a number"),
        ('length="50" id', 'length="-50" id', "<road> has length=-50; give a number from 0 to 100000"),
        ('length="50" id', 'length="1e9" id', "<road> has length=1e9; give a number"),
        ('length="50" id', 'length="0" id', "its length is 0; give its length in metres"),
        ('length="50" id', 'length="long" id', "<road> has length=long; give a number"),
        ('length="50" id', "id", "<road> has length=None; give a number"),
        ('length="50" id', 'length="80" id', r"its <geometry> at s=0 reaches 50 m, but .* is at 80 m; make them meet"),
        ('x="0"', 'x="nan"', "<geometry> has x=nan; give a number"),
        ('x="0"', 'x="4e6"', "<geometry> has x=4e6; give a number from -100000 to 100000"),
        ('hdg="0"', 'hdg="-inf"', "<geometry> has hdg=-inf"),
        ('length="50"><', 'length="-3"><', "<geometry> has length=-3; give a number from 0"),
        ('length="50"><', 'length="0"><', "its planView has no <geometry> at s=0; add one"),
        (LINE, "", "its planView has no <geometry> at s=0; add one"),
        ("<line/>", "<bezier/>", r"a <geometry> has \[\]; give it one of line, arc, spiral, poly3, paramPoly3"),
        ("<line/>", '<line/><arc curvature="1"/>', r"a <geometry> has \['arc', 'line'\]; give it one of line"),
        ("<line/>", '<arc curvature="100"/>', "<arc> has curvature=100; give a number from -10 to 10"),
        ("<line/>", '<spiral curvStart="0" curvEnd="nan"/>', "<spiral> has curvEnd=nan"),
        ("<line/>", '<poly3 a="0" b="0" c="1e300" d="0"/>', "<poly3> has c=1e300; give a number from -1e\\+06"),
        ("<line/>", '<paramPoly3 pRange="s"/>', "<paramPoly3> has pRange=s; give normalized or arcLength"),
        (
            LINE,
            LINE.replace('"50"', '"20"') + LINE.replace('s="0" x="0"', 's="20" x="99"').replace('"50"', '"30"'),
            r"its <geometry> at s=20 is 79\.0 m from the end of the one before; join them",
        ),
        ('a="4.0"', 'a="nan"', "<width> has a=nan"),
        ('a="4.0"', 'a="1e5"', r"road 5 section 0 lane 1 lies .* and is 100000 m wide; at most 110 km and 30 m"),
        ("<width", "<border", "lane 1 is given by <border>; give its <width>"),
        ('<width sOffset="0" a="4.0" b="0" c="0" d="0"/>', "", "lane 1 has no <width>; give one"),
        ('<lane id="1"', '<lane id="one"', "<lane> has id=one; give a number"),
        ('<laneSection s="0"', '<laneSection s="9"', "its lane sections start at 9 to 9 m; let the first start at 0"),
        ('<laneSection s="0"', '<laneSection s="0" singleSide="true"', "a <laneSection> is singleSide; list the lanes"),
        ('junction="-1"', 'junction="-1" rule="MIDDLE"', "its traffic rule is MIDDLE; give RHT or LHT"),
        ('contactPoint="end"', 'contactPoint="middle"', "<predecessor> has contactPoint=middle; give start or end"),
        ('id="5"', 'id=""', "road '': give it an id of its own"),
    ],
)
def test_bad_values_are_named_with_their_road(old, new, message, xodr, save):
    text = xodr.opendrive(xodr.straight(5, 0, 0, 0, 50, xodr.lane(1), start="road 5 end"))
    assert old in text
    with pytest.raises(ValueError, match=rf"map .*map\.xodr: .*{message}") as caught:
        Town.load(save(text.replace(old, new)))
    assert "road 5" in str(caught.value).replace("'", "") or "road ''" in str(caught.value)


def test_two_roads_of_one_id(xodr, save):
    text = xodr.opendrive(*[xodr.straight(5, 0, 0, 0, 50, xodr.lane(1))] * 2)
    with pytest.raises(ValueError, match="road '5': give it an id of its own"):
        Town.load(save(text))


def test_roads_longer_than_all_limits(xodr, save):
    long = [xodr.straight(k, 0, 0, 0, 99_000, xodr.lane(1)) for k in range(11)]
    with pytest.raises(ValueError, match="road '10': roads are longer than 1000 km up to here; cut the map"):
        Town.load(save(xodr.opendrive(*long)))
    wide = xodr.straight(1, 0, 0, 0, 99_000, *[xodr.lane(k) for k in range(1, 12)])
    with pytest.raises(ValueError, match="its lanes are 1089 km long, the limit is 1000; cut it into parts"):
        Town.load(save(xodr.opendrive(wide)))


def test_a_map_too_large_for_its_rasters(xodr, save):
    """A ring street of 3 by 3 km."""
    side, quarter, text, s = 3000, 20 * math.pi / 2, "", 0.0
    for k, (x, y) in enumerate([(0, 0), (side, 0), (side, side), (0, side)]):
        hdg = k * math.pi / 2
        cos, sin = math.cos(hdg), math.sin(hdg)
        text += xodr.geometry(s, x + 20 * cos, y + 20 * sin, hdg, side - 40)
        ahead = (x + (side - 20) * cos, y + (side - 20) * sin)
        text += xodr.geometry(s + side - 40, *ahead, hdg, quarter, '<arc curvature="0.05"/>')
        s += side - 40 + quarter
    lanes = xodr.section(0, xodr.lane(-1, before=-1, after=-1))
    ring = xodr.road(1, s, text, lanes, start="road 1 end", end="road 1 start")
    with pytest.raises(ValueError, match=r"map .*map\.xodr: the map covers 3\.0 by 3\.0 km; cut it to an area of 4"):
        Town.load(save(xodr.opendrive(ring)))
