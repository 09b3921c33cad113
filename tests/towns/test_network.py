"""The spatial index against highway-env's scan of all lanes."""

import math

import numpy as np
import pytest
from highway_env.road.lane import AbstractLane, CircularLane, PolyLaneFixedWidth, SineLane, StraightLane
from highway_env.road.road import RoadNetwork

from ldrl.towns.network import IndexedNetwork


@pytest.fixture(scope="module")
def zoo():
    """Lanes of all of highway-env's types: crossing, side by side, wavy, longer than half a circle."""
    network = RoadNetwork()
    for k in range(3):
        network.add_lane("a", "b", StraightLane((0, 4 * k), (90, 4 * k)))
    network.add_lane("b", "c", SineLane((90, 0), (190, 20), amplitude=4, pulsation=0.1, phase=1))
    network.add_lane("c", "d", CircularLane((190, 60), 40, -math.pi / 2, math.pi, clockwise=True))
    network.add_lane("d", "a", CircularLane((120, 60), 10, 0, -math.pi / 2, clockwise=False))
    arc = [(100 + 40 * math.cos(t), -20 + 60 * math.sin(t)) for t in np.linspace(0, 2, 30)]
    network.add_lane("a", "c", PolyLaneFixedWidth(arc))
    network.add_lane("c", "a", StraightLane((190, 20), (0, 0)))
    return network


def poses(network, count, seed):
    """Positions on, beside and far from the lanes, and any headings."""
    rng = np.random.default_rng(seed)
    lanes = network.lanes_list()
    on = []
    for lane in rng.choice(len(lanes), count // 2):
        on.append(lanes[lane].position(rng.uniform(-5, lanes[lane].length + 5), rng.normal(0, 3)))
    low, high = np.min(on, 0) - 60, np.max(on, 0) + 60
    return np.concatenate([on, rng.uniform(low, high, (count // 2, 2))]), rng.uniform(-7, 7, 2 * (count // 2))


def assert_same(network, index, count, seed=0):
    for position, heading in zip(*poses(network, count, seed), strict=True):
        for angle in (float(heading), None):
            assert index.get_closest_lane_index(position, angle) == network.get_closest_lane_index(position, angle)


def test_same_lane_as_the_scan_in_the_towns(town):
    assert_same(town.network, IndexedNetwork(town.network.graph), 500)


def test_same_lane_as_the_scan_for_every_type_of_lane(zoo):
    assert_same(zoo, IndexedNetwork(zoo.graph), 800)


def test_the_first_of_equally_close_lanes_wins():
    index = IndexedNetwork()
    for name, y in {"q": 1, "p": -3, "r": -3}.items():  # p and r are nearer to the middle of the cell
        index.add_lane(name, name, StraightLane((0, y), (50, y)))
    assert index.get_closest_lane_index(np.array([20.0, -1.0]), 0.3) == ("q", "q", 0)
    assert index.get_closest_lane_index(np.array([20.0, -1.1]), 0.3) == ("p", "p", 0)


def test_lanes_added_later_are_found(zoo):
    index = IndexedNetwork({start: dict(ends) for start, ends in zoo.graph.items()})
    position = np.array([300.0, 300.0])
    before = index.get_closest_lane_index(position, 0.0)
    index.add_lane("x", "y", StraightLane((290, 300), (310, 300)))
    assert index.get_closest_lane_index(position, 0.0) == ("x", "y", 0) != before


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_lost_car_has_the_same_lane(zoo):
    index = IndexedNetwork(zoo.graph)
    for position in ([math.nan, 0.0], [math.inf, 0.0], [1e7, -1e7]):
        assert index.get_closest_lane_index(np.array(position), 1.0) == zoo.get_closest_lane_index(
            np.array(position), 1.0
        )


def test_a_look_up_looks_at_few_lanes(town1, monkeypatch):
    asked, original = [], AbstractLane.distance_with_heading
    monkeypatch.setattr(
        AbstractLane, "distance_with_heading", lambda lane, *pose: asked.append(lane) or original(lane, *pose)
    )
    index = IndexedNetwork(town1.network.graph)
    on_lanes = poses(town1.network, 400, 1)[0][:200]
    for position in on_lanes:
        index.get_closest_lane_index(position, 0.0)
    assert len(asked) < 8 * len(on_lanes) < len(town1.network.lanes_list()) * len(on_lanes)


def test_surroundings_hold_every_car_on_their_lanes(town1, zoo):
    rng = np.random.default_rng(0)
    for network in (town1.network, zoo):
        index = IndexedNetwork(network.graph)
        for lane_index, lane in network.lanes_dict().items():
            around, (left, right, top, bottom) = index.surroundings(lane_index)
            near = set(around.lanes_list())
            assert lane in near
            for (start, end, _), other in network.lanes_dict().items():
                assert (other in near) == (
                    (start, end) == lane_index[:2] or start == lane_index[1] or end == lane_index[0]
                )
            for k, other in enumerate(around.lanes_list()):
                for _ in range(20):
                    along, beside = rng.uniform(-5, other.length + 5), rng.uniform(-1, 1)
                    x, y = other.position(along, beside * (other.width_at(along) / 2 + 1))
                    assert left[k, 0] <= x <= right[k, 0]
                    assert top[k, 0] <= y <= bottom[k, 0]
