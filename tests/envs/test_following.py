"""Car following: against highway-env's own IDM vehicles, and who is ahead against plain loops."""

import math

import numpy as np
import pytest
import torch
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from ldrl.envs import vehicle
from ldrl.envs.following import distance_on_path, distance_on_route, idm_acceleration
from ldrl.envs.traffic import Traffic
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES, Layout, Town
from ldrl.towns.layout import Node

LIMIT = 20 / 3.6


@pytest.fixture(scope="module")
def ring():
    """A ring with streets 1,000 m long and no junction."""
    nodes = {"a": Node(0, 0, 8), "b": Node(1000, 0, 8), "c": Node(1000, 1000, 8), "d": Node(0, 1000, 8)}
    return Town("ring", Layout("ring", 4.0, nodes, (("a", "b", "c", "d", "a"),)).network())


def straight_road():
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 0], [1000, 0], speed_limit=LIMIT))
    return Road(network, np_random=np.random.RandomState(0))


def idm_vehicle(road, x, speed, target, heading=0.0):
    car = IDMVehicle(road, [x, 0.0], heading, speed, target_speed=target, enable_lane_change=False)
    road.vehicles.append(car)
    return car


def around(town, lane):
    """The route window of a car on a lane that takes the first way on."""
    route = [int(town.lane_predecessor[lane]), lane]
    while len(route) < ROUTE_LANES:
        route.append(town.successors(route[-1])[0])
    return torch.tensor(route)


def test_acceleration_equals_highway_envs():
    generator = np.random.default_rng(0)
    for _ in range(200):
        road = straight_road()
        gap, speed, front_speed, turn = generator.uniform((2, 0, 0, -1), (60, 8, 8, 1))
        target = generator.uniform(3, LIMIT)
        car = idm_vehicle(road, 100.0, speed, target)
        front = idm_vehicle(road, 100.0 + gap, front_speed, target, turn)
        for leader, distance, projected in ((front, gap, front_speed * math.cos(turn)), (None, math.inf, 0.0)):
            expected = np.clip(car.acceleration(car, leader), -IDMVehicle.ACC_MAX, IDMVehicle.ACC_MAX)
            numbers = (torch.tensor(v, dtype=torch.float64) for v in (speed, target, distance, projected))
            assert float(idm_acceleration(*numbers)) == pytest.approx(expected, abs=1e-9)


def test_a_platoon_moves_as_highway_envs(ring, nobody):
    """Six cars with gaps from 12 to 40 m, two of them slow, for a minute: positions and speeds at every step."""
    starts = [20.0, 32.0, 50.0, 90.0, 110.0, 135.0]
    speeds, targets = [5.0, 2.0, 5.5, 4.0, 3.0, 5.0], [5.5, 5.0, 5.5, 5.2, 3.0, 4.0]
    road = straight_road()
    cars = [idm_vehicle(road, *values) for values in zip(starts, speeds, targets, strict=True)]
    traffic = Traffic(ring, 1, 6, torch.Generator(), ring.points)
    lane = ring.lane_indices.index(("a>b:start", "a>b:end", 0))
    traffic._route[:] = around(ring, lane)
    traffic._position[0], traffic._speed[0], traffic._desired[0] = map(torch.tensor, (starts, speeds, targets))
    traffic._path = traffic._look_ahead()
    origin = traffic.state[0, 0, 0] - starts[0]
    hardest = 0.0
    for _ in range(600):
        before = traffic.state[0, :, 3]
        traffic.step(torch.ones(1, dtype=torch.bool), nobody(1))
        road.act()
        expected = [car.action["acceleration"] for car in cars]
        road.step(vehicle.TIME_STEP)
        state = traffic.state[0]
        assert ((state[:, 3] - before) / vehicle.TIME_STEP).tolist() == pytest.approx(expected, abs=1e-3)
        assert state[:, 3].tolist() == pytest.approx([car.speed for car in cars], abs=1e-4)
        assert (state[:, 0] - origin).tolist() == pytest.approx([car.position[0] for car in cars], abs=1e-2)
        hardest = min(hardest, *expected)
    assert hardest < -2  # the followers did brake


def test_brakes_at_the_limit_and_never_reverses(ring, nobody):
    traffic = Traffic(ring, 1, 2, torch.Generator(), ring.points)
    traffic._route[:] = around(ring, ring.lane_indices.index(("a>b:start", "a>b:end", 0)))
    traffic._position[0], traffic._speed[0], traffic._desired[0] = torch.tensor([[50.0, 58.0], [5.0, 0.0], [5.0, 1e-9]])
    traffic._path = traffic._look_ahead()
    for _ in range(20):
        before = float(traffic._speed[0, 0])
        traffic.step(torch.ones(1, dtype=torch.bool), nobody(1))
        assert 0 <= traffic._speed[0, 0] <= before
        assert before - float(traffic._speed[0, 0]) <= 0.6 + 1e-6
    assert traffic._speed[0, 0] == 0
    assert 50 < traffic._position[0, 0] < 53  # 3 m behind the other's tail


def test_distance_on_route_equals_a_loop(town2):
    traffic = Traffic(town2, 3, 60, torch.Generator().manual_seed(0), town2.points)
    traffic.reset(torch.ones(3, dtype=torch.bool), torch.full((3, 3), 1e6))
    route, position = traffic._route, traffic._position.clone()
    junctions = (town2.lane_manoeuvre != SubTask.LANEFOLLOW).nonzero().flatten().tolist()
    for car, lane in zip(range(0, 60, 3), junctions, strict=False):  # a third of them in junctions
        route[0, car], position[0, car] = around(town2, lane), 3.0
    found = distance_on_route(town2, route, position)
    branches = [{lane, *town2.successors(int(town2.lane_predecessor[lane]))} for lane in range(len(town2.lane_length))]
    count = 0
    for world in range(3):
        for i in range(60):
            for j in range(60):
                nearest, start = math.inf, -float(position[world, i])
                for lane in route[world, i, 1:].tolist():
                    distance = start + float(position[world, j])
                    if int(route[world, j, 1]) in branches[lane] and distance > 0:
                        nearest = min(nearest, distance)
                    start += float(town2.lane_length[lane])
                count += nearest < math.inf
                assert float(found[world, i, j]) == pytest.approx(nearest, abs=1e-3)
    assert count > 100


def test_distance_on_path_equals_a_driven_footprint(crossing):
    """A car is in the way at the first place of the path where a car there would touch it, half a length further on."""
    traffic = Traffic(crossing, 1, 60, torch.Generator().manual_seed(0), crossing.points)
    traffic.reset(torch.ones(1, dtype=torch.bool), torch.full((1, 3), 1e6))
    generator = torch.Generator().manual_seed(0)
    path = traffic._look_ahead()[0]
    steps = torch.arange(0, 36, 0.1)
    points, headings = crossing.sample(traffic._route, traffic._position.unsqueeze(-1) + steps)
    driven = torch.cat((points, headings.unsqueeze(-1)), -1)[0]
    where = torch.randint(0, 330, (60,), generator=generator)
    others = driven[torch.arange(60), where]
    aside = (torch.rand(60, generator=generator) - 0.5) * 12
    others = torch.stack((
        others[:, 0] - aside * others[:, 2].sin(),
        others[:, 1] + aside * others[:, 2].cos(),
        torch.rand(60, generator=generator) * 7,
    ), -1)  # fmt: skip
    found = distance_on_path(path, others.unsqueeze(1)).squeeze(1)
    for margin, must in ((-0.25, True), (0.7, False)):
        touched = vehicle.overlap(driven, others.unsqueeze(1), margin)
        beside = touched[:, where.max() + 1 :].any(-1)  # too far ahead to say
        for car in range(60):
            if beside[car]:
                continue
            first = float(steps[touched[car]].min()) if touched[car].any() else math.inf
            if must and first < math.inf:
                assert float(found[car]) < first + 8
            if not must and first == math.inf:
                assert found[car] == math.inf
    assert 10 < found.isfinite().sum() < 50


def test_distance_on_path_of_nobody_is_infinite():
    path = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert distance_on_path(path, torch.tensor([[math.nan] * 3, [-3.0, 0.0, 0.0]])).tolist() == [math.inf, math.inf]
