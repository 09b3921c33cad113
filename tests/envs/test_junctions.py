"""Right of way: which lanes exclude one another, against finely driven footprints, and who enters first."""

import math

import pytest
import torch

from ldrl.envs import vehicle
from ldrl.envs.junctions import Junctions, distance_to_entry, distance_to_stop_line
from ldrl.envs.traffic import Agent, Traffic
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES

EVERY = torch.ones(1, dtype=torch.bool)
ARMS = {"north": "10", "east": "21", "south": "12", "west": "01"}


def through(town, start, end):
    """The street to the four-way junction, the lane through it and the street behind it."""
    a, b = ARMS[start], ARMS[end]
    names = [(f"{a}>11:start", f"{a}>11:end"), (f"{a}>11:end", f"11>{b}:start"), (f"11>{b}:start", f"11>{b}:end")]
    return [town.lane_indices.index((*name, 0)) for name in names]


def window(town, start, end):
    approach, lane, exit_ = through(town, start, end)
    route = [int(town.lane_predecessor[approach]), approach, lane, exit_]
    while len(route) < ROUTE_LANES:
        route.append(town.successors(route[-1])[0])
    return route


def place(town, cars):
    """A world with cars ``(start, end, metres before the entry, speed)`` around the four-way junction."""
    traffic = Traffic(town, 1, len(cars), torch.Generator().manual_seed(0), town.points)
    for k, (start, end, before, speed) in enumerate(cars):
        traffic._route[0, k] = torch.tensor(window(town, start, end))
        traffic._position[0, k] = town.lane_length[traffic._route[0, k, 1]] - before
        traffic._speed[0, k] = speed
    traffic._desired[:] = 5.0
    traffic._path = traffic._look_ahead()
    return traffic


def agent(town, start, end, before, speed):
    route, nearer = torch.tensor([window(town, start, end)]), torch.tensor([before])
    position = town.lane_length[route[:, 1]] - nearer
    point, heading = town.sample(route, position.unsqueeze(-1))
    return Agent(torch.cat((point[:, 0], heading), -1), torch.tensor([speed]), route, position)


def order_of_entry(traffic, other, steps=300):
    entered = []
    for _ in range(steps):
        traffic.step(EVERY, other)
        inside = (traffic.town.lane_manoeuvre[traffic._route[0, :, 1]] != SubTask.LANEFOLLOW).nonzero().flatten()
        entered += [k for k in inside.tolist() if k not in entered]
        state = traffic.state[0, :, :3]
        assert vehicle.overlap(state.unsqueeze(0), state.unsqueeze(1)).sum() == len(state)
    return entered


@pytest.mark.parametrize(("first", "second", "excludes"), [
    (("north", "south"), ("south", "north"), False),
    (("north", "south"), ("east", "west"), True),  # they cross
    (("north", "south"), ("east", "south"), True),  # they merge
    (("north", "south"), ("north", "west"), True),  # they part
    (("north", "west"), ("south", "east"), False),  # two right turns
    (("north", "east"), ("south", "north"), True),  # a left turn and oncoming traffic
    (("north", "west"), ("west", "north"), False),  # right and left turn around the same corner
    (("north", "west"), ("east", "south"), False),
])  # fmt: skip
def test_which_lanes_exclude_one_another(crossing, first, second, excludes):
    exclude = Junctions(crossing).exclude
    one, other = through(crossing, *first)[1], through(crossing, *second)[1]
    assert bool(exclude[one, other]) == bool(exclude[other, one]) == excludes


def test_cars_on_lanes_that_do_not_exclude_one_another_never_touch(town):
    junctions = Junctions(town)
    assert not junctions.exclude[town.lane_manoeuvre == SubTask.LANEFOLLOW].any()
    assert not junctions.exclude.diagonal().any()
    inside = (town.lane_manoeuvre != SubTask.LANEFOLLOW).nonzero().flatten()
    poses = []
    for lane in inside.tolist():
        route = [int(town.lane_predecessor[lane]), lane, *[town.successors(lane)[0]] * 4]
        point, heading = town.sample(torch.tensor(route), torch.arange(-3.5, float(town.lane_length[lane]) + 3, 0.4))
        poses.append(torch.cat((point, heading.unsqueeze(-1)), -1))
    agree = total = 0
    for i, first in zip(inside.tolist(), poses, strict=True):
        for j, second in zip(inside.tolist(), poses, strict=True):
            if i < j and float((first[0, :2] - second[0, :2]).norm()) < 60:
                touch = bool(vehicle.overlap(first.unsqueeze(1), second).any())
                assert not touch or junctions.exclude[i, j]
                agree, total = agree + (touch == bool(junctions.exclude[i, j])), total + 1
    assert agree > 0.9 * total  # and hardly any pair is excluded for nothing
    assert total > 100


def test_distances_to_the_entry_and_the_stop_line(crossing):
    route = torch.tensor([window(crossing, "north", "south")] * 4)
    length = crossing.lane_length[route[:, 1]]
    before = torch.tensor([30.0, 20.0, 3.5, 2.0])
    assert distance_to_entry(crossing, route, length - before).tolist() == pytest.approx(before.tolist())
    inside = torch.cat((route[:, 1:], route[:, -1:]), -1)
    assert distance_to_entry(crossing, inside, torch.ones(4)).tolist() == [math.inf] * 4
    stays = distance_to_stop_line(before, torch.zeros(4, dtype=torch.bool))
    assert stays.tolist() == [math.inf, 26.5, 10.0, 8.5]  # 10 m is where a standing follower stands
    assert distance_to_stop_line(before, torch.ones(4, dtype=torch.bool)).tolist() == [math.inf] * 4


def test_first_come_first_served(crossing, nobody):
    cars = [("north", "south", 37.0, 5.0), ("east", "west", 26.0, 5.0), ("west", "north", 31.0, 5.0)]
    assert order_of_entry(place(crossing, cars), nobody(1)) == [1, 2, 0]


def test_ties_go_to_the_lower_index(crossing, nobody):
    cars = [(start, end, 3.5, 0.0) for start, end in zip(ARMS, ("south", "west", "north", "east"), strict=True)]
    assert order_of_entry(place(crossing, cars), nobody(1)) == [0, 1, 2, 3]


def test_lanes_that_do_not_exclude_one_another_are_driven_together(crossing, nobody):
    traffic = place(crossing, [("north", "south", 10.0, 5.0), ("south", "north", 10.0, 5.0)])
    for _ in range(20):
        traffic.step(EVERY, nobody(1))
        assert traffic._speed.min() > 4.9


def test_nobody_enters_without_room_behind(crossing, nobody):
    """Car 1 stands so close behind the junction that car 0 would stop in it."""
    approach, lane, exit_ = through(crossing, "north", "south")
    traffic = place(crossing, [("north", "south", 15.0, 5.0), ("north", "south", 40.0, 0.0)])
    traffic._route[0, 1] = torch.tensor([lane, *[exit_] * 5])
    for position, enters in ((12.5, False), (13.5, True)):
        for _ in range(200):
            traffic._position[0, 1], traffic._speed[0, 1] = position, 0.0
            traffic.step(EVERY, nobody(1))
        assert (int(traffic._route[0, 0, 1]) != approach) == enters
        tail = float(traffic._position[0, 0]) - 2.5
        assert tail > 0 if enters else -2 < float(crossing.lane_length[approach]) - tail - 6 < 0


def test_room_is_kept_for_cars_that_are_still_in_the_junction(crossing, nobody):
    """There is room for one car before the standing one, and car 1 is about to take it."""
    approach, lane, exit_ = through(crossing, "north", "south")
    traffic = place(
        crossing, [("north", "south", 15.0, 5.0), ("north", "south", 0.0, 5.0), ("north", "south", 0.0, 0.0)]
    )
    traffic._route[0, 1] = torch.tensor([approach, lane, *[exit_] * 4])
    traffic._route[0, 2] = torch.tensor([lane, *[exit_] * 5])
    traffic._position[0, 1] = 3.0
    for _ in range(200):
        traffic._position[0, 2], traffic._speed[0, 2] = 18.0, 0.0
        traffic.step(EVERY, nobody(1))
    assert traffic._route[0, :, 1].tolist() == [approach, exit_, exit_]


def test_an_agent_behind_another_car_claims_nothing(crossing):
    traffic = place(crossing, [("south", "north", 3.5, 0.0)])
    for _ in range(30):
        traffic.step(EVERY, agent(crossing, "south", "north", 15.0, 5.0))
    assert int(traffic._route[0, 0, 1]) == through(crossing, "south", "north")[1]


def test_the_agent_goes_first_unless_it_stands(crossing):
    cars = [("east", "west", 12.0, 5.0)]
    for speed, waits in ((5.0, True), (0.0, False)):
        traffic = place(crossing, cars)
        for _ in range(100):
            traffic.step(EVERY, agent(crossing, "south", "north", 15.0, speed))
        approach = through(crossing, "east", "west")[0]
        assert (int(traffic._route[0, 0, 1]) == approach) == waits
        assert not waits or traffic._speed[0, 0] < 0.1


def test_a_car_that_can_no_longer_stop_keeps_its_right_of_way(crossing):
    """At 5 m/s it needs 6.25 m at 2 m/s^2, from its nose to the entry."""
    approach = through(crossing, "east", "west")[0]
    for before, goes in ((8.6, True), (8.9, False)):
        traffic = place(crossing, [("east", "west", before, 5.0)])
        traffic._may_enter[:] = True
        other = agent(crossing, "south", "north", 15.0, 5.0)
        assert bool(traffic.right_of_way(other.route, other.position)) != goes
        for _ in range(40):
            traffic.step(EVERY, other)
        assert (int(traffic._route[0, 0, 1]) != approach) == goes
        assert goes or traffic._position[0, 0] + 2.5 < crossing.lane_length[approach]


def test_the_agents_right_of_way(crossing):
    other = agent(crossing, "south", "north", 15.0, 5.0)
    _, lane, exit_ = through(crossing, "east", "west")
    traffic = place(crossing, [("east", "west", 20.0, 5.0)])
    for position, on, free in ((8.0, lane, False), (2.9, exit_, False), (3.1, exit_, True)):
        before = lane if on == exit_ else exit_
        traffic._route[0, 0] = torch.tensor([before, on, *[exit_] * 4])
        traffic._position[:] = position
        assert bool(traffic.right_of_way(other.route, other.position)) == free
    oncoming = place(crossing, [("north", "south", 3.0, 5.0)])
    oncoming._may_enter[:] = True
    assert oncoming.right_of_way(other.route, other.position)
    turning = agent(crossing, "south", "west", 15.0, 5.0)  # to the left, across its lane
    assert not oncoming.right_of_way(turning.route, turning.position)
