"""From OpenDRIVE maps to networks: links, manoeuvres, merging, what is left out, and cars that drive there."""

import math
import re
import warnings
from collections import Counter

import numpy as np
import pytest
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle

from ldrl.language import KEYWORDS
from ldrl.subtasks import SubTask
from ldrl.towns import Town, UnrealisableError, plan_route, plan_routes
from ldrl.towns.opendrive import load_network
from ldrl.towns.opendrive.graph import chains
from ldrl.towns.opendrive.junctions import FOLLOW, classify, leave_out_u_turns
from ldrl.towns.opendrive.lanes import LaneKey, sample_road
from ldrl.towns.opendrive.links import link_lanes
from ldrl.towns.opendrive.reader import read_opendrive
from ldrl.towns.surface import sample

L, R, S, F = SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT, SubTask.LANEFOLLOW


def lanes_by_manoeuvre(network):
    return Counter(lane.manoeuvre for lane in network.lanes_list())


def at(network, position, heading=None):
    """The lane at a place."""
    return network.get_lane(network.get_closest_lane_index(np.array(position), heading))


def ends(town):
    """Where each lane ends."""
    last = town.lane_first + (town.lane_length / town.lane_spacing).round().long()
    return town.points[last].tolist()


def ring(xodr, *extra, ways="", **road):
    """Road 1, a closed oval of one lane that runs anticlockwise on the map, from and to (0, 0)."""
    geometry, s = "", 0.0
    for x, y, hdg, length, shape in (
        (0, 0, 0, 100, "<line/>"),
        (100, 0, 0, 20 * math.pi, '<arc curvature="0.05"/>'),
        (100, 40, math.pi, 100, "<line/>"),
        (0, 40, math.pi, 20 * math.pi, '<arc curvature="0.05"/>'),
    ):
        geometry += xodr.geometry(s, x, y, hdg, length, shape)
        s += length
    options = {"start": "road 1 end", "end": "road 1 start"} | road
    return xodr.road(1, s, geometry, ways or xodr.section(0, xodr.lane(-1, before=-1, after=-1)), **options)


@pytest.fixture(scope="module")
def theta(xodr, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "theta.xodr"
    path.write_text(xodr.theta(), encoding="utf-8")
    return Town.load(path)


@pytest.mark.parametrize("side", [-1, 1])
def test_two_junctions_and_three_streets(side, xodr, save):
    network = load_network(save(xodr.theta(side)))
    assert lanes_by_manoeuvre(network) == {F: 6, L: 4, R: 4, S: 4}
    for (start, end, _), lane in network.lanes_dict().items():
        following = [after for afters in network.graph[end].values() for after in afters]
        assert len(following) == (1 if lane.manoeuvre != F else 2), (start, end)
        for after in following:
            assert after.position(0, 0) == pytest.approx(lane.position(lane.length, 0), abs=1e-6)
            assert np.cos(after.heading_at(0) - lane.heading_at(lane.length)) == pytest.approx(1, abs=1e-6)
    # eastbound on the middle street: right of its centre is south, y = 2, and left is north
    eastbound = at(network, (100, -2 * side), 0.0)
    assert abs(eastbound.position(50, 0)[1] - -2 * side) < 1e-6
    # its next junction is in the east; a left turn there leads north, to smaller y
    end = network.get_closest_lane_index(np.array((100, -2 * side)), 0.0)[1]
    turns = {after.manoeuvre: after for afters in network.graph[end].values() for after in afters}
    assert set(turns) == {L, R}
    assert turns[L].position(turns[L].length, 0)[1] < -5
    assert turns[R].position(turns[R].length, 0)[1] > 5
    radius = {manoeuvre: lane.length / (math.pi / 2) for manoeuvre, lane in turns.items()}
    assert radius[L] == pytest.approx(10 - 2 * side, abs=1e-3)
    assert radius[R] == pytest.approx(10 + 2 * side, abs=1e-3)


def test_a_town_of_it(theta):
    assert theta.name == "theta.xodr"
    assert len(theta.approaches()) == 6
    assert {len(plan_routes(theta, KEYWORDS[name])) for name in ("left", "right", "straight")} == {4}
    length = 180 + 2 * (80 + 160 + 20 * math.pi)
    on_street = theta.lane_manoeuvre == F
    assert float(theta.lane_length[on_street].sum()) == pytest.approx(2 * length, abs=0.5)


def test_roads_and_sections_without_a_branch_are_one_lane(xodr, save):
    """A ring of three roads, the last drawn against traffic, the first with three sections."""
    geometry = [xodr.geometry(0, 0, 0, 0, 100), xodr.geometry(0, 100, 0, 0, 20 * math.pi, '<arc curvature="0.05"/>')]
    back = xodr.geometry(0, 0, 0, math.pi, 20 * math.pi, '<arc curvature="-0.05"/>')
    back += xodr.geometry(20 * math.pi, 0, 40, 0, 100)
    second = xodr.section(0, xodr.lane(-1, before=-1, after=1))
    third = xodr.section(0, xodr.lane(1, before=-1, after=-1))
    first = xodr.section(0, xodr.lane(-1, before=1, after=-1))
    for s in (40, 40.005):  # the middle section is too short to be sampled
        first += xodr.section(s, xodr.lane(-1, before=-1, after=-1))
    roads = [
        xodr.road(1, 100, geometry[0], first, start="road 3 start", end="road 2 start"),
        xodr.road(2, 20 * math.pi, geometry[1], second, start="road 1 end", end="road 3 end"),
        xodr.road(3, 100 + 20 * math.pi, back, third, start="road 1 start", end="road 2 end"),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        network = load_network(save(xodr.opendrive(*roads)))
    (lane,) = network.lanes_list()
    assert lane.length == pytest.approx(200 + 2 * math.pi * 22, abs=0.1)
    assert lane.manoeuvre == F
    town = Town("ring", network)
    assert town.successors(0) == [0]
    assert town.approaches() == []
    for s in np.arange(0, lane.length, 3.0):
        x, y = lane.position(s, 0)
        beyond = x - np.clip(x, 0, 100)
        assert np.hypot(beyond, y + 20) == pytest.approx(22, abs=1e-3)


def pocket(xodr):
    """The map with a second lane eastwards on street 2, which opens 60 m before the junction and alone turns right."""
    text = xodr.theta()
    options = {"start": "junction 100", "end": "junction 200"}
    old = xodr.straight(2, 10, 0, 0, 180, xodr.lane(1), xodr.lane(-1), **options)
    sections = xodr.section(0, xodr.lane(1, before=None), xodr.lane(-1, after=-1))
    opening = xodr.lane(-2, "0 0 0 0.0133333 -0.000296296", "30 4 0 0 0")
    sections += xodr.section(120, xodr.lane(1, before=1), xodr.lane(-1, before=-1), opening)
    wide = xodr.road(2, 180, xodr.geometry(0, 10, 0, 0, 180), sections, **options)
    turn = re.search(r'<road name="" length="[^"]*" id="201".*?</road>', text).group()
    geometry = xodr.geometry(0, 190, -6, 0, 4) + xodr.geometry(4, 194, -6, 0, 2 * math.pi, '<arc curvature="-0.25"/>')
    lanes = xodr.section(0, xodr.lane(-1, before=-2, after=1))
    ends = {"start": "road 2 end", "end": "road 3 end", "junction": 200}
    offset = '<laneOffset s="0" a="2" b="0" c="0" d="0"/>'
    tighter = xodr.road(201, 4 + 2 * math.pi, geometry, lanes, offset=offset, **ends)
    right = xodr.connection(2, 201, "start", (-1, -1))
    for before, after in ((old, wide), (turn, tighter), (right, xodr.connection(2, 201, "start", (-2, -1)))):
        assert before in text
        text = text.replace(before, after)
    return text


def test_a_pocket_for_turning_is_a_fork_before_the_junction(xodr, save):
    town = Town.load(save(pocket(xodr)))
    assert len(town.lane_length) == 18 + 2
    (fork,) = [i for i, end in enumerate(ends(town)) if end == pytest.approx((130, 2), abs=0.01)]
    assert float(town.lane_length[fork]) == pytest.approx(120, abs=0.5)
    ahead, beside = sorted(town.successors(fork), key=lambda i: float(town.points[town.lane_first[i] + 100, 1]))
    assert town.points[town.lane_first[ahead]].tolist() == pytest.approx([130, 2], abs=0.01)
    assert town.points[town.lane_first[beside]].tolist() == pytest.approx([130, 2], abs=0.01)
    assert [SubTask(int(town.lane_manoeuvre[k])) for i in (ahead, beside) for k in town.successors(i)] == [L, R]
    # routes take the right prong ...
    for name, prong in (("left", ahead), ("right", beside)):
        for first in ("left", "right"):
            found = [route for route in plan_routes(town, KEYWORDS[f"{first},{name}"]) if fork in route.lanes[:-1]]
            assert len(found) == 1
            assert found[0].lanes[found[0].lanes.index(fork) + 1] == prong
            assert all(b in town.successors(a) for a, b in zip(found[0].lanes, found[0].lanes[1:], strict=False))
    # ... and both prongs know what the road offers
    for prong, name in ((ahead, "right"), (beside, "left")):
        assert {town.lane_options[k] for k in town.successors(prong)} == {frozenset((L, R))}
        with pytest.raises(UnrealisableError, match="offers only"):
            plan_route(town, KEYWORDS[name], prong)


def test_a_lane_that_only_turns_right_is_an_approach_of_its_own(xodr, save):
    town = Town.load(save(pocket(xodr)))
    (turn,) = [i for i in range(20) if town.points[town.lane_first[i]].tolist() == pytest.approx([190, 6], abs=0.01)]
    approach = int(town.lane_predecessor[turn])
    assert plan_route(town, KEYWORDS["first right"], approach).lanes[1] == turn
    with pytest.raises(UnrealisableError):
        plan_route(town, KEYWORDS["first left"], approach)  # the next left would be the second


def fan(xodr, *ways):
    """A road, a junction, and for each ``(curvature, length)`` a connecting road and a road behind it; open ends."""
    roads = [xodr.straight(1, -20, 0, 0, 20, xodr.lane(-1), end="junction 9")]
    connections = []
    for k, (curvature, length) in enumerate(ways):
        turn = curvature * length
        x, y = (math.sin(turn) / curvature, (1 - math.cos(turn)) / curvature) if curvature else (length, 0)
        shape = f'<arc curvature="{curvature}"/>'
        lanes = xodr.section(0, xodr.lane(-1, before=-1, after=-1))
        ends = {"start": "road 1 end", "end": f"road {50 + k} start", "junction": 9}
        roads.append(xodr.road(10 + k, length, xodr.geometry(0, 0, 0, 0, length, shape), lanes, **ends))
        roads.append(xodr.straight(50 + k, x, y, turn, 20, xodr.lane(-1), start="junction 9"))
        connections.append(xodr.connection(1, 10 + k, "start", (-1, -1)))
    return xodr.opendrive(*roads, xodr.junction(9, *connections))


@pytest.mark.parametrize(
    ("ways", "expected"),
    [
        ([(0.1, 15.7), (0, 20), (-0.1, 15.7)], [L, S, R]),
        ([(0.1, 15.7), (-0.1, 15.7)], [L, R]),
        ([(0.02, 20), (-0.05, 14)], [S, R]),  # 23 and 40 degrees
        ([(0.05, 14), (-0.05, 14)], [L, R]),  # a Y
        ([(0, 60), (-0.005, 60)], [S, R]),  # an exit: 17 degrees
        ([(0.005, 60), (0, 60), (-0.001, 60)], [L, S, R]),
        ([(0, 20), (0.25, 12.4)], [F, None]),  # a U-turn is left out, and then there is nothing to choose
        ([(0.1, 15.7), (-0.1, 15.7), (0.25, 12.4)], [L, R, None]),
        ([(0.1, 15.7)], [F]),
        ([(0.25, 12.4)], [F]),  # the only way
    ],
)
def test_manoeuvres_by_where_the_ways_lead(ways, expected, xodr, save):
    source = read_opendrive(save(fan(xodr, *ways)))
    pieces = {key: piece for road in source.roads.values() for key, piece in sample_road(road).items()}
    links, broken = link_lanes(source, pieces)
    assert not broken
    graph = chains(links)
    leave_out_u_turns(graph, source, pieces)
    tasks = classify(graph, source, pieces)
    for k, manoeuvre in enumerate(expected):
        key = LaneKey(str(10 + k), 0, -1)
        assert ((key,) in graph.after) == (manoeuvre is not None)
        if manoeuvre is not None:
            assert tasks.get(key, FOLLOW).manoeuvre == manoeuvre
    offered = frozenset(expected) - {None, F}
    assert all(task.options == offered for task in tasks.values())


def test_a_junction_with_one_way_on_is_no_junction(xodr, save):
    """The oval with its last bend in a junction."""
    geometry = xodr.geometry(0, 0, 0, 0, 100) + xodr.geometry(100, 100, 0, 0, 20 * math.pi, '<arc curvature="0.05"/>')
    geometry += xodr.geometry(100 + 20 * math.pi, 100, 40, math.pi, 100)
    bend = xodr.geometry(0, 0, 40, math.pi, 20 * math.pi, '<arc curvature="0.05"/>')
    lane = xodr.section(0, xodr.lane(-1, before=-1, after=-1))
    roads = [
        xodr.road(1, 200 + 20 * math.pi, geometry, lane, start="junction 5", end="junction 5"),
        xodr.road(2, 20 * math.pi, bend, lane, start="road 1 end", end="road 1 start", junction=5),
    ]
    network = load_network(save(xodr.opendrive(*roads, xodr.junction(5, xodr.connection(1, 2, "start", (-1, -1))))))
    (lane,) = network.lanes_list()
    assert lane.manoeuvre == F
    assert lane.length == pytest.approx(200 + 2 * math.pi * 22, abs=0.1)


def test_a_direct_junction_joins_roads_without_a_connecting_one(xodr, save):
    """OpenDRIVE 1.7: the oval's end joined with its start in a junction, by ``linkedRoad``."""
    text = ring(xodr, start="junction 5", end="junction 5")
    link = xodr.connection(1, 1, "start", (-1, -1)).replace("connectingRoad", "linkedRoad")
    network = load_network(save(xodr.opendrive(text, xodr.junction(5, link), version="1.7")))
    (lane,) = network.lanes_list()
    assert lane.length == pytest.approx(200 + 2 * math.pi * 22, abs=0.1)
    assert Town("oval", network).successors(0) == [0]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (
            lambda x: [x.straight(9, 0, 200, 0, 50, x.lane(-1), x.lane(1))],
            "nothing leads .* road 9 section 0 lane -1; .*",
        ),
        (
            lambda x: [x.straight(9, -50, 0, 0, 50, x.lane(-1, after=-1), end="road 1 start")],
            "nothing leads on from, or to, road 9 section 0 lane -1$",
        ),
        (
            lambda x: [
                x.straight(8, 0, 200, 0, 50, x.lane(-1, after=-1), end="road 9 start"),
                x.straight(9, 50, 200, 0, 50, x.lane(-1), start="road 8 end"),
            ],
            "nothing leads on from, or to, road 8 section 0 lane -1 and road 9 section 0 lane -1",
        ),
        (
            lambda x: [x.straight(9, 0, 200, 0, 50, x.lane(-1, after=-1), end="road 77 start")],
            "road 9 section 0 lane -1 leads to road '77', which does not exist; nothing leads",
        ),
        (
            lambda x: [x.straight(9, 0, 200, 0, 50, x.lane(-1, after=-4), end="road 1 start")],
            "road 9 section 0 lane -1 is linked with lane -4 of road 1, which does not exist",
        ),
        (
            lambda x: [x.straight(9, 0, 200, 0, 50, x.lane(-1, after=-1), end="road 1 start")],
            r"road 9 section 0 lane -1 ends 206\.2 m from road 1 section 0 lane -1, which is to follow it",
        ),
        (
            lambda x: [x.junction(5, x.connection(1, 88, "start", (-1, -1)))],
            "junction 5 connects road '88', which does not",
        ),
    ],
)
def test_what_leads_nowhere_is_left_out_and_named(extra, message, xodr, save):
    with pytest.warns(UserWarning, match=rf"map .*map\.xodr: left out what cannot be driven for ever: {message}"):
        network = load_network(save(xodr.opendrive(ring(xodr), *extra(xodr))))
    assert len(network.lanes_list()) == 1


def test_a_map_of_dead_ends_is_refused(xodr, save):
    with pytest.raises(ValueError, match=r"no lane leads on for ever; join its roads into loops: .*road 5"):
        load_network(save(xodr.opendrive(xodr.straight(5, 0, 0, 0, 50, xodr.lane(-1)))))
    with pytest.raises(ValueError, match=r"no lane leads on for ever; .* and 30 more"):
        load_network(save(xodr.opendrive(*[xodr.straight(k, 0, 9 * k, 0, 50, xodr.lane(-1)) for k in range(50)])))
    with pytest.raises(ValueError, match=r"no lane leads on for ever"):
        load_network(save(fan(xodr, (0.1, 15.7), (-0.1, 15.7))))  # a junction that leads nowhere
    with pytest.raises(ValueError, match="it has no lane for cars; give one with lanes of type 'driving'"):
        load_network(save(xodr.opendrive(xodr.straight(5, 0, 0, 0, 50, xodr.lane(-1, kind="sidewalk")))))


def test_a_lane_that_opens_and_closes_again(xodr, save):
    """Beside the ring's lane a second one for 60 m: nothing links it in the file."""
    sections = xodr.section(0, xodr.lane(-1, before=-1, after=-1))
    sections += xodr.section(
        20, xodr.lane(-1, before=-1, after=-1), xodr.lane(-2, "0 0 0.2 0 0", "20 4 0 0 0", "40 4 -0.2 0 0")
    )
    sections += xodr.section(80, xodr.lane(-1, before=-1, after=-1))
    town = Town.load(save(xodr.opendrive(ring(xodr, ways=sections))))
    assert sorted(town.lane_length.tolist()) == pytest.approx([60, 60.6, 140 + 40 * math.pi + 4 * math.pi], abs=0.5)
    assert sorted(map(len, map(town.successors, range(3)))) == [1, 1, 2]
    road = sample(
        town.road_distance, town.raster_origin, town.points.new_tensor([[50, 7.9], [50, 8.6], [90, 3.9], [90, 4.6]])
    )
    assert (road.flatten() < 0).tolist() == [True, False, True, False]  # lanes of 4 m and a shoulder of 0.3 m


def test_links_that_share_only_some_lanes_are_not_mixed_up(xodr, save):
    """Two lanes end at 60 m: the first leads to two lanes, the second, which closes, only to the inner one."""
    opening, closing = "0 0 0.4 0 0", "30 4 -0.4 0 0"
    sections = xodr.section(0, xodr.lane(-1, before=-1, after=-1), xodr.lane(-2, "0 0 0.2 0 0", after=-2))
    outer = xodr.lane(-2, "0 4 0 0 0", closing, before=-2, after=-1)
    sections += xodr.section(20, xodr.lane(-1, before=-1, after=-1), outer)
    another = xodr.lane(-2, opening, "10 4 0 0 0", closing, before=-1)
    sections += xodr.section(60, xodr.lane(-1, before=-1, after=-1), another)
    sections += xodr.section(100, xodr.lane(-1, before=-1, after=-1))
    town = Town.load(save(xodr.opendrive(ring(xodr, ways=sections))))
    meet = [i for i, end in enumerate(ends(town)) if end == pytest.approx((60, 2), abs=0.01)]
    lengths = [sorted(town.lane_length[town.successors(i)].tolist()) for i in meet]
    inner, outer = pytest.approx(40, abs=0.01), pytest.approx(41.5, abs=0.5)
    assert sorted(lengths, key=len) == [[inner], [inner, outer]]


def test_highway_env_drives_on_it(theta):
    """A car of highway-env's keeps to its lane through bends and a junction."""
    road = Road(theta.network, np_random=np.random.RandomState(0))
    (approach,) = [i for i, end in enumerate(ends(theta)) if end == pytest.approx((190, 2), abs=0.01)]
    index = theta.lane_indices[approach]
    lane = theta.network.get_lane(index)
    car = IDMVehicle(road, lane.position(150, 0), lane.heading_at(150), speed=5.0, target_lane_index=index)
    road.vehicles.append(car)
    seen = set()
    for _ in range(150):
        road.act()
        road.step(0.1)
        seen.add(car.lane_index)
        assert abs(car.lane.local_coordinates(car.position)[1]) < 1.0
        assert car.on_road
    assert len(seen) >= 3
    assert car.speed > 3
