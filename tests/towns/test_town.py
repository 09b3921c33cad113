"""Towns as tensors against the networks that they are made of."""

import math

import numpy as np
import pytest
import torch
from highway_env.road.lane import StraightLane
from highway_env.road.road import RoadNetwork

from ldrl.subtasks import MANOEUVRES, SubTask
from ldrl.towns import ROUTE_LANES, Town
from ldrl.towns.surface import sample


def random_routes(town, count, seed=0):
    """Random route windows, ``[count, 6]``."""
    rng = np.random.default_rng(seed)
    routes = []
    for _ in range(count):
        lanes = [int(rng.integers(len(town.lane_length)))]
        while len(lanes) < ROUTE_LANES:
            lanes.append(int(rng.choice(town.successors(lanes[-1]))))
        routes.append(lanes)
    return torch.tensor(routes)


def positions_on(town, routes, per_route=8, seed=0):
    """Random route positions on the window's lanes, ``[B, N]``."""
    length = town.lane_length[routes]
    first, last = -length[:, :1], length[:, 1:].sum(-1, keepdim=True)
    return first + torch.rand(len(routes), per_route, generator=torch.Generator().manual_seed(seed)) * (last - first)


def test_lanes_are_those_of_the_network(town):
    lanes = town.network.lanes_dict()
    assert sorted(town.lane_indices) == sorted(lanes)
    for i, index in enumerate(town.lane_indices):
        lane = lanes[index]
        assert town.lane_length[i] == pytest.approx(lane.length)
        assert town.lane_manoeuvre[i] == lane.manoeuvre


def test_every_lanes_successors_connect(town):
    for i, (_, end, _) in enumerate(town.lane_indices):
        following = town.successors(i)
        assert sorted(town.lane_indices[j] for j in following) == sorted((end, k, 0) for k in town.network.graph[end])
        lane = town.network.get_lane(town.lane_indices[i])
        for j in following:
            after = town.network.get_lane(town.lane_indices[j])
            assert after.position(0, 0) == pytest.approx(lane.position(lane.length, 0), abs=1e-3)
        padded = town.lane_successors[i].tolist()
        assert set(padded) == set(following)
        assert i in town.successors(int(town.lane_predecessor[i]))


def test_approaches_lead_into_junctions(town):
    into = [
        i for i in range(len(town.lane_length)) if any(town.lane_manoeuvre[j] in MANOEUVRES for j in town.successors(i))
    ]
    assert town.approaches() == into
    assert len(into) == {"town1": 36, "town2": 24}[town.name]


def test_distance_to_the_next_junction(town):
    found = 0
    for lane in range(len(town.lane_length)):
        expected, at = 0.0, town.successors(lane)[0]
        while town.lane_manoeuvre[at] == SubTask.LANEFOLLOW:
            expected += town.network.get_lane(town.lane_indices[at]).length
            at = town.successors(at)[0]
        assert float(town.lane_to_junction[lane]) == pytest.approx(expected, abs=1e-3)
        found += expected > 0
    assert found > 5


def test_locate(town):
    routes = random_routes(town, 20)
    length = town.lane_length[routes]
    starts = length.cumsum(-1) - length - length[:, :1]
    window, along = town.locate(routes, starts + 0.25 * length)
    assert (window == torch.arange(ROUTE_LANES)).all()
    torch.testing.assert_close(along, 0.25 * length, atol=1e-3, rtol=0)
    window, along = town.locate(routes, -length[:, :1] - 5)
    assert (window == 0).all()
    assert along.flatten().tolist() == pytest.approx([-5.0] * 20, abs=1e-3)


def test_sample_is_the_networks_geometry(town):
    routes = random_routes(town, 30)
    position = positions_on(town, routes)
    points, headings = town.sample(routes, position)
    window, along = town.locate(routes, position)
    for b in range(len(routes)):
        for n in range(position.shape[1]):
            lane = town.network.get_lane(town.lane_indices[routes[b, window[b, n]]])
            assert points[b, n].tolist() == pytest.approx(lane.position(float(along[b, n]), 0).tolist(), abs=0.01)
            error = math.remainder(float(headings[b, n]) - lane.heading_at(float(along[b, n])), math.tau)
            assert error == pytest.approx(0, abs=1e-3)


def test_sample_stops_at_the_windows_ends(town):
    routes = random_routes(town, 5)
    end = town.lane_length[routes][:, 1:].sum(-1, keepdim=True)
    torch.testing.assert_close(town.sample(routes, end + 100)[0], town.sample(routes, end)[0])
    start = -town.lane_length[routes][:, :1]
    torch.testing.assert_close(town.sample(routes, start - 100)[0], town.sample(routes, start)[0])


@pytest.mark.parametrize("guess_error", [-3.0, 0.0, 3.0])
def test_project_inverts_sample(town, guess_error):
    routes = random_routes(town, 200)
    position = positions_on(town, routes, 1).squeeze(-1)
    point, heading = town.sample(routes, position.unsqueeze(-1))
    point, heading = point.squeeze(1), heading.squeeze(1)
    offset = torch.rand(200, generator=torch.Generator().manual_seed(1)) * 4 - 2
    beside = point + offset.unsqueeze(-1) * torch.stack((-heading.sin(), heading.cos()), -1)
    found, cross_track, direction = town.project(routes, beside, position + guess_error)
    torch.testing.assert_close(found, position, atol=0.06, rtol=0)
    torch.testing.assert_close(cross_track, offset, atol=0.01, rtol=0)
    torch.testing.assert_close(torch.cos(direction - heading), torch.ones(200), atol=1e-3, rtol=0)


def test_surface_follows_the_lanes(town):
    points, headings = town.points, town.headings
    on = sample(town.road_distance, town.raster_origin, points).squeeze(-1)
    assert on.max() < -1.9  # 2.3 m to the edge, in a cell of half a metre
    lane = torch.searchsorted(town.lane_first, torch.arange(len(points)), right=True) - 1
    straight = torch.tensor([isinstance(town.network.get_lane(index), StraightLane) for index in town.lane_indices])
    street = straight[lane] & (town.lane_manoeuvre[lane] == SubTask.LANEFOLLOW)
    right = torch.stack((-headings.sin(), headings.cos()), -1)
    for beyond in (-0.2, 0.2, 2.0):
        distance = sample(town.road_distance, town.raster_origin, points + (2.3 + beyond) * right).squeeze(-1)[street]
        middle = distance.median()
        assert float(middle) == pytest.approx(beyond, abs=0.02)


def test_lane_directions(town):
    lane = torch.searchsorted(town.lane_first, torch.arange(len(town.points)), right=True) - 1
    ahead = torch.stack((town.headings.cos(), town.headings.sin()), -1)
    right = torch.stack((-ahead[:, 1], ahead[:, 0]), -1)
    follows = town.lane_manoeuvre[lane] == SubTask.LANEFOLLOW
    # a metre from either end of a lane the nearest cell may belong to the next one
    first, last = (
        town.lane_first[lane],
        town.lane_first[lane] + (town.lane_length / town.lane_spacing).round().long()[lane],
    )
    inner = ((torch.arange(len(lane)) - first) >= 2) & ((last - torch.arange(len(lane))) >= 2)

    def along(offset):
        direction = sample(town.lane_direction, town.raster_origin, town.points + offset * right, "nearest")
        return (direction * ahead).sum(-1)

    assert along(0.0)[follows & inner].min() > 0.95
    assert along(1.5)[follows & inner].min() > 0.95
    assert along(-4.0)[follows & inner].max() < -0.95  # the oncoming lane
    assert along(4.0)[follows & inner].abs().max() == 0  # off the road
    assert along(0.0)[~follows & inner].abs().max() == 0  # in a junction


def test_a_lane_that_leads_nowhere_is_named():
    network = RoadNetwork()
    lane = StraightLane((0, 0), (50, 0))
    lane.manoeuvre = SubTask.LANEFOLLOW
    network.add_lane("a", "b", lane)
    with pytest.raises(ValueError, match="town 'short': the lane 'a' to 'b' leads nowhere; connect its end"):
        Town("short", network)


def test_unknown_town_is_named():
    with pytest.raises(ValueError, match=r"'town3'; use one of town1, town2, random-<seed>, or the path"):
        Town.load("town3")


def test_moves_with_to_and_says_its_name(town):
    assert f"'{town.name}', " in repr(town)
    assert "points" in dict(town.named_buffers())
    assert not town.state_dict()  # a checkpoint does not hold the map
