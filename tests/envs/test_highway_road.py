"""The fast road against highway-env's, and how its traffic drives."""

import math

import numpy as np
import pytest
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

from ldrl.envs.highway_road import IndexedRoad
from ldrl.envs.highway_traffic import TrafficVehicle, mark_crossings, spawn
from ldrl.subtasks import SubTask
from ldrl.towns import load_layout
from ldrl.towns.network import IndexedNetwork

FAR_AWAY = (-500.0, -500.0, 0.0)


@pytest.fixture(scope="module", params=("town1", "town2"))
def network(request):
    network = load_layout(request.param).network()
    mark_crossings(network)
    return network


@pytest.fixture(scope="module")
def town2():
    network = load_layout("town2").network()
    mark_crossings(network)
    return network


def make_road(network, cars=0, *, indexed=True, vehicle_class=TrafficVehicle, seed=0):
    rng = np.random.default_rng(seed)
    road = IndexedRoad(IndexedNetwork(network.graph), np_random=rng) if indexed else Road(network, np_random=rng)
    road.neighbour_vehicles_connected_lanes = True
    spawn(road, cars, vehicle_class, FAR_AWAY)
    return road


def states(road):
    return np.array([[*car.position, car.heading, car.speed, car.crashed] for car in road.vehicles])


def drive(road, steps):
    seen = []
    for _ in range(steps):
        road.act()
        road.step(0.1)
        seen.append(states(road))
    return np.array(seen)


def scatter(road, network, count, rng):
    """Cars and things anywhere near the lanes, some on top of each other."""
    lanes = network.lanes_list()
    for k in rng.choice(len(lanes), count):
        position = lanes[k].position(rng.uniform(-3, lanes[k].length + 3), rng.normal(0, 2))
        kind = rng.choice([Vehicle, Vehicle, IDMVehicle, Obstacle, Landmark])
        thing = kind(road, position, rng.uniform(-4, 4), rng.uniform(0, 8))
        (road.vehicles if isinstance(thing, Vehicle) else road.objects).append(thing)


@pytest.mark.parametrize("connected", [True, False])
def test_same_neighbours_as_highway_envs_road(network, connected):
    rng = np.random.default_rng(3)
    road = make_road(network)
    scatter(road, network, 150, rng)
    road.neighbour_vehicles_connected_lanes = connected
    plain = Road(network, road.vehicles, road.objects, rng, False, connected)
    found = 0
    for vehicle in road.vehicles:
        lanes = [None, vehicle.lane_index, list(network.lanes_dict())[rng.integers(len(network.lanes_dict()))]]
        for lane_index in lanes:
            expected = plain.neighbour_vehicles(vehicle, lane_index)
            assert road.neighbour_vehicles(vehicle, lane_index) == expected
            found += sum(neighbour is not None for neighbour in expected)
    assert found > 100


@pytest.mark.parametrize("vehicle_class", [TrafficVehicle, IDMVehicle])
def test_same_trajectories_as_on_highway_envs_road(town2, vehicle_class):
    fast, plain = (make_road(town2, 25, indexed=indexed, vehicle_class=vehicle_class) for indexed in (True, False))
    seen = drive(fast, 60)
    assert np.array_equal(seen, drive(plain, 60))
    assert np.abs(seen[-1, :, :2] - seen[0, :, :2]).max(1).min() > 1


def test_same_collisions_as_on_highway_envs_road(town2):
    roads = []
    for indexed in (True, False):
        road = make_road(town2, indexed=indexed)
        scatter(road, town2, 120, np.random.default_rng(0))
        roads.append(road)
    seen = drive(roads[0], 20)
    assert np.array_equal(seen, drive(roads[1], 20))
    crashed = seen[-1, :, 4].sum()
    assert 5 < crashed < seen.shape[1] - 5
    assert [thing.hit for thing in roads[0].objects] == [thing.hit for thing in roads[1].objects]


def test_traffic_neither_crashes_nor_jams(network):
    road = make_road(network, 30)
    seen = drive(road, 600)
    assert not seen[..., 4].any()
    assert seen[..., 3].min() > -1e-9
    assert seen[..., 3].max() < 20 / 3.6 + 0.1
    assert seen[..., 3].mean() > 4
    assert seen[-200:, :, 3].max(0).min() > 2  # nobody stands for long


def test_traffic_turns_every_way_and_stays_in_lane(town2):
    road, taken, off = make_road(town2, 20), set(), []
    for _ in range(600):
        road.act()
        road.step(0.1)
        for car in road.vehicles:
            lane = town2.get_lane(car.target_lane_index)
            taken.add(lane.manoeuvre)
            off.append(lane.local_coordinates(car.position)[1])
    assert taken == set(SubTask) - {SubTask.FINISH}
    assert np.abs(off).max() < 1.5


def test_claims_exclude_each_other(town2):
    road, held = make_road(town2, 30), 0
    for _ in range(300):
        road.act()
        road.step(0.1)
        claims = {car.claim for car in road.vehicles if car.claim}
        held += len(claims)
        assert all(claims.isdisjoint(town2.get_lane(claim).crossing) for claim in claims)
    assert held > 300


def junction(network, of=0):
    """The arms of the ``of``-th T-junction: its lanes by manoeuvre."""
    ends = sorted({start for (start, _, _), lane in network.lanes_dict().items() if lane.manoeuvre == SubTask.STRAIGHT})
    start = ends[of]
    return {lane.manoeuvre: (start, end, 0) for end, (lane,) in network.graph[start].items()}


def test_crossings_of_a_t_junction(network):
    lanes = network.lanes_dict()
    on_junctions = {index: lane for index, lane in lanes.items() if lane.manoeuvre != SubTask.LANEFOLLOW}
    for index, lane in on_junctions.items():
        for other in lane.crossing:
            assert index in on_junctions[other].crossing
            assert other[0] != index[0]
    for of in range(4):
        ways = junction(network, of)
        assert len(ways) == 2
        straight = lanes[ways[SubTask.STRAIGHT]]
        end = straight.position(straight.length, 0)
        opposite = [
            index
            for index, lane in on_junctions.items()
            if lane.manoeuvre == SubTask.STRAIGHT and 3.9 < math.dist(lane.position(0, 0), end) < 4.1
        ]
        assert len(opposite) == 1  # side by side, 4 m apart
        assert not lanes[opposite[0]].crossing & {ways[SubTask.STRAIGHT]}
        # a T has six lanes; each crosses or meets some of the four from the other arms, but not all
        assert 1 <= len(straight.crossing) <= 3


def test_a_car_gives_way_to_one_that_crosses(town2):
    way = junction(town2)[SubTask.STRAIGHT]
    crossing = sorted(town2.get_lane(way).crossing)[0]
    approach = next((start, end, 0) for start, ends in town2.graph.items() for end in ends if end == way[0])
    for blocked in (True, False):
        road = make_road(town2)
        lane, other = town2.get_lane(approach), town2.get_lane(crossing)
        start = lane.position(lane.length - 15, 0), lane.heading_at(0)
        car = TrafficVehicle(road, *start, 5.0, approach, 5.5, [approach, way])
        road.vehicles.append(car)
        if blocked:
            middle = other.length / 2
            road.vehicles.append(Vehicle(road, other.position(middle, 0), other.heading_at(middle), 0.0))
        drive(road, 80)
        front = lane.local_coordinates(car.position)[0] + car.LENGTH / 2
        assert (front <= lane.length - 0.5 and car.speed < 0.3) if blocked else front > lane.length + 10
        assert not car.crashed


def test_cars_start_apart_and_do_not_touch(town2):
    lane = town2.get_lane(junction(town2)[SubTask.STRAIGHT])
    agent = (*lane.position(0, 0), lane.heading_at(0))
    for seed in range(5):
        road = make_road(town2, seed=seed)
        spawn(road, 60, TrafficVehicle, agent)
        road.vehicles.append(Vehicle(road, agent[:2], agent[2], 4.7))
        start = states(road)
        assert len(start) == 61
        apart = np.hypot(*(start[:, None, :2] - start[:, :2]).transpose(2, 0, 1)) + 100 * np.eye(61)
        same_way = np.cos(start[:, None, 2] - start[:, 2]) > -0.5
        assert apart[same_way].min() > 9.8
        assert apart.min() > 3.5
        assert not drive(road, 10)[..., 4].any()


def test_too_many_cars(town2):
    with pytest.raises(ValueError, match=r"vehicles_count=5000, but only \d+ cars fit; ask for fewer"):
        make_road(town2, 5000)


def test_a_car_around_the_corner_is_not_right_ahead(town2):
    road = make_road(town2)
    index, lane = next((index, lane) for index, lane in town2.lanes_dict().items() if lane.length > 60)
    car = TrafficVehicle(road, lane.position(30, 0), lane.heading_at(30), 5.0)
    across, behind = (Vehicle(road, lane.position(*place), 0.0, 5.0) for place in ((31, 50), (20, 0)))
    assert car.lane_index == index
    assert IDMVehicle.lane_distance_to(car, across) == pytest.approx(1)
    assert car.lane_distance_to(across) == pytest.approx(math.hypot(1, 50))
    assert car.lane_distance_to(behind) == pytest.approx(-10)
