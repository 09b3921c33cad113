"""Street layouts: the two towns against figures from CARLA's maps, sound lanes, a car that drives them, errors.

``opendrive_lanes.csv`` holds points on the lane centres of CARLA's Town01.xodr and Town02.xodr (Computer Vision Center
at UAB, CC-BY 4.0), y and heading flipped to this package's frame: at least one on every lane, in its middle on bends
and in junctions.
"""

import csv
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle

from ldrl.subtasks import MANOEUVRES, SubTask
from ldrl.towns.layout import LAYOUTS, Layout, Node, load_layout

TOWNS = ("town1", "town2")
GRID = """
name: grid
lane_width: 4.0
nodes:
  a: [0, 0, 8]
  b: [60, 0, 8]
  c: [120, 0, 8]
  d: [0, 60, 8]
  e: [60, 60, 8]
  f: [120, 60, 8]
  g: [0, 120, 8]
  h: [60, 120, 8]
  i: [120, 120, 8]
streets:
  - [a, b, c]
  - [d, e, f]
  - [g, h, i]
  - [a, d, g]
  - [b, e, h]
  - [c, f, i]
"""
TRIANGLE = Layout(
    "triangle", 3.5, {"a": Node(0, 0, 8), "b": Node(90, 10, 6), "c": Node(30, 80, 12)}, (("a", "b", "c", "a"),)
)
ALMOST_STRAIGHT = Layout(
    "bent",
    4.0,
    {"a": Node(0, 0, 8), "m": Node(50, 0.2, 8), "b": Node(100, 0, 8), "c": Node(50, 60, 8)},
    (("a", "m", "b", "c", "a"),),
)


def read(tmp_path: Path, text: str) -> Layout:
    path = tmp_path / "layout.yaml"
    path.write_text(text, encoding="utf-8")
    return Layout.from_yaml(path)


def angle_between(a: float, b: float) -> float:
    return abs(math.remainder(a - b, math.tau))


def nearest_lane(network, position, heading):
    """Index of the nearest lane that runs within 60 degrees of the heading, distance and angle to it."""
    found = []
    for index, lane in network.lanes_dict().items():
        along = float(np.clip(lane.local_coordinates(position)[0], 0, lane.length))
        angle = angle_between(lane.heading_at(along), heading)
        if angle < math.pi / 3:
            found.append((float(np.linalg.norm(lane.position(along, 0) - position)), angle, index))
    distance, angle, index = min(found)
    return index, distance, angle


def successors(network, index):
    return [(index[1], end, 0) for end in network.graph[index[1]]]


@pytest.fixture(scope="module")
def networks():
    return {name: load_layout(name).network() for name in TOWNS}


@pytest.fixture(scope="module")
def carla_lanes():
    path = Path(__file__).with_name("opendrive_lanes.csv")
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("town", TOWNS)
def test_lane_centres_lie_on_carlas(town, networks, carla_lanes):
    network, met = networks[town], set()
    rows = [row for row in carla_lanes if row["town"] == town]
    for row in rows:
        position, heading = np.array([float(row["x"]), float(row["y"])]), math.radians(float(row["heading_degrees"]))
        index, distance, angle = nearest_lane(network, position, heading)
        if row["manoeuvre"] == "LANEFOLLOW":
            assert distance < 0.5, row
            assert math.degrees(angle) < 10, row
        else:
            assert distance < 1.0, row
        assert network.get_lane(index).manoeuvre is SubTask[row["manoeuvre"]], row
        met.add(index)
    assert met == set(network.lanes_dict())  # and no lane is ours alone


@pytest.mark.parametrize(("town", "junctions"), [("town1", 12), ("town2", 8)])
def test_junctions_are_t_shaped(town, junctions, networks):
    lanes: dict[str, Counter] = {}
    for (start, _, _), lane in networks[town].lanes_dict().items():
        if lane.manoeuvre in MANOEUVRES:
            lanes.setdefault(start.split(">")[1].split(":")[0], Counter())[lane.manoeuvre] += 1
    assert len(lanes) == junctions
    assert all(count == {SubTask.LEFT: 2, SubTask.RIGHT: 2, SubTask.STRAIGHT: 2} for count in lanes.values())


def test_four_way_junction(tmp_path):
    network = read(tmp_path, GRID).network()
    lanes = [lane for (start, _, _), lane in network.lanes_dict().items() if start.endswith(">e:end")]
    assert Counter(lane.manoeuvre for lane in lanes) == dict.fromkeys(MANOEUVRES, 4)


def test_right_hand_traffic_and_turns(tmp_path):
    network = read(tmp_path, GRID).network()
    east = network.get_lane(("d>e:start", "d>e:end", 0))
    assert east.start == pytest.approx([8, 62])  # y points south, so the right of an eastbound car is at larger y
    assert east.end == pytest.approx([52, 62])
    right = network.get_lane(("d>e:end", "e>h:start", 0))
    assert (right.manoeuvre, right.radius) == (SubTask.RIGHT, pytest.approx(6))
    assert right.position(right.length, 0) == pytest.approx([58, 68])
    left = network.get_lane(("d>e:end", "e>b:start", 0))
    assert (left.manoeuvre, left.radius) == (SubTask.LEFT, pytest.approx(10))
    assert left.position(left.length, 0) == pytest.approx([62, 52])


@pytest.mark.parametrize("layout", [*map(load_layout, TOWNS), TRIANGLE], ids=lambda layout: layout.name)
def test_lanes_are_connected(layout):
    network = layout.network()
    lanes = network.lanes_dict()
    assert {index[2] for index in lanes} == {0}
    for index, lane in lanes.items():
        assert lane.length > 0
        following = successors(network, index)
        assert following
        for after in (network.get_lane(other) for other in following):
            assert after.position(0, 0) == pytest.approx(lane.position(lane.length, 0), abs=1e-6)
            assert angle_between(after.heading_at(0), lane.heading_at(lane.length)) < 1e-6


def test_almost_straight_corner_is_a_straight_lane():
    lane = ALMOST_STRAIGHT.network().get_lane(("a>m:end", "m>b:start", 0))
    assert isinstance(lane, StraightLane)
    assert lane.manoeuvre is SubTask.LANEFOLLOW
    assert lane.length == pytest.approx(16, abs=0.1)


@pytest.mark.parametrize("town", TOWNS)
@pytest.mark.parametrize("manoeuvre", MANOEUVRES, ids=lambda manoeuvre: manoeuvre.name)
def test_highway_env_vehicle_drives_for_30_seconds(town, manoeuvre, networks):
    network = networks[town]
    lanes = network.lanes_dict()
    tightest = min((i for i, lane in lanes.items() if lane.manoeuvre is manoeuvre), key=lambda i: lanes[i].length)
    route = [next(i for i in lanes if tightest in successors(network, i)), tightest]
    while sum(lanes[i].length for i in route) < 500:
        route.append(successors(network, route[-1])[-1])
    street = lanes[route[0]]
    road = Road(network, np_random=np.random.RandomState(0))
    position, heading = street.position(street.length - 15, 0), street.heading_at(0)
    car = ControlledVehicle(road, position, heading, speed=5.5, target_lane_index=route[0], route=route[:])
    road.vehicles.append(car)
    driven = set()
    for _ in range(30 * 15):
        road.act()
        road.step(1 / 15)
        assert min(lanes[i].distance(car.position) for i in route) < 2
        assert car.on_road
        driven.add(car.target_lane_index)
    assert driven == set(route[: len(driven)])
    assert tightest in driven
    assert car.speed == pytest.approx(5.5, abs=0.1)


def test_lanes_have_their_look(networks):
    for lane in networks["town1"].lanes_list():
        assert lane.width_at(0) == 4.0
        assert lane.speed_limit == pytest.approx(5.56, abs=0.01)
        assert lane.line_types in ([(0, 0)] if lane.manoeuvre in MANOEUVRES else [(0, 2), (1, 2)])


def test_layouts_are_listed_and_checked():
    assert set(TOWNS) <= set(LAYOUTS)
    with pytest.raises(ValueError, match=r"unknown layout 'town3'.*town1, town2"):
        load_layout("town3")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lane_width: 4.0", "", "expected exactly the keys"),
        ("lane_width: 4.0", "lane_width: wide", "'wide' is no number"),
        ("lane_width: 4.0", "lane_width: 0", "at least lane_width 0 > 0"),
        ("e: [60, 60, 8]", "e: [60, sixty, 8]", "node 'e'.*'sixty' is no number"),
        ("e: [60, 60, 8]", "e: [60, .nan, 8]", "node 'e'.*nan is no number"),
        ("e: [60, 60, 8]", "e: [60, 60]", r"node 'e' is \[60, 60\]; write \[x, y, radius\]"),
        ("e: [60, 60, 8]", "e: [60, 60, 3]", "node 'e': radius 3 must be at least lane_width 4.0"),
        ("e: [60, 60, 8]", "e: [60, 62, 8]", "junction 'd': 'e' and 'a' are 91.9 degrees apart; make it 90 or 180"),
        ("e: [60, 60, 8]", "e: [60, 60, 55]", "street .-e is 60.0 m long, the turns at its ends need 63.0 m; move"),
        ("[d, e, f]", "[d, e, z]", "street e-z: unknown node 'z'; add it"),
        ("[d, e, f]", "[d, e, f, e]", "street f-e is listed twice; remove one"),
        ("[d, e, f]", "d", "streets must be a list of lists"),
        ("streets:", "  z: [60, 200, 8]\nstreets:", "node 'z' is a dead end, 0 street"),
        ("[b, e, h]", "[b, e, h, z]\nstreets_end: 1", "expected exactly the keys"),
    ],
)
def test_bad_layouts_are_named(tmp_path, old, new, message):
    assert GRID.count(old) == 1
    with pytest.raises(ValueError, match=message):
        read(tmp_path, GRID.replace(old, new))


def test_dead_end_is_named(tmp_path):
    text = GRID.replace("streets:", "  z: [60, 200, 8]\nstreets:").replace("[b, e, h]", "[b, e, h, z]")
    with pytest.raises(ValueError, match=r"layout 'grid': node 'z' is a dead end, 1 street\(s\); join two or more"):
        read(tmp_path, text)
