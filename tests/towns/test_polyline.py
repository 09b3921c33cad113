"""The polyline lane against highway-env's exact lanes."""

import json

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, StraightLane, lane_from_config

from ldrl.towns.polyline import PolylineLane

EXACT = [
    CircularLane((10.0, -5.0), 12.0, -2.0, 1.0, clockwise=True, width=3.5),
    CircularLane((0.0, 4.0), 30.0, 2.5, 0.0, clockwise=False, width=3.5),
    StraightLane((5.0, 5.0), (-40.0, 20.0), 3.5),
]


def sampled(lane, step=0.25):
    along = np.linspace(0, lane.length, round(lane.length / step) + 1)
    headings = [np.angle(np.exp(1j * lane.heading_at(s))) for s in along]  # wrapped, as a file may say them
    return PolylineLane([lane.position(s, 0) for s in along], headings, [lane.width_at(s) for s in along])


@pytest.mark.parametrize("exact", EXACT)
def test_a_sampled_lane_is_the_lane(exact):
    lane = sampled(exact)
    assert lane.length == pytest.approx(exact.length, rel=1e-4)
    for part in np.linspace(0.01, 0.99, 23):
        for lateral in (-2.0, 0.0, 1.5):
            s = part * exact.length
            position = exact.position(s, lateral)
            assert lane.position(part * lane.length, lateral) == pytest.approx(position, abs=2e-3)
            assert np.cos(lane.heading_at(s) - exact.heading_at(s)) == pytest.approx(1, abs=1e-6)
            assert lane.local_coordinates(position) == pytest.approx((part * lane.length, lateral), abs=5e-3)
            assert lane.distance(position) == pytest.approx(abs(lateral), abs=5e-3)
            assert lane.on_lane(position) == exact.on_lane(position)


@pytest.mark.parametrize("exact", EXACT)
def test_it_runs_on_straight_beyond_its_ends(exact):
    lane = sampled(exact)
    for s, beyond in ((0.0, -4.0), (lane.length, 6.0)):
        heading = lane.heading_at(s)
        expected = lane.position(s, 0) + beyond * np.array((np.cos(heading), np.sin(heading)))
        assert lane.position(s + beyond, 0) == pytest.approx(expected)
        assert lane.local_coordinates(expected) == pytest.approx((s + beyond, 0), abs=1e-6)


def test_width_changes_along_it():
    lane = PolylineLane([(0, 0), (10, 0), (10, 10)], [0, 0.5, 1.5], [3, 4, 2])
    assert [lane.width_at(s) for s in (-5, 0, 5, 10, 15, 99)] == [3, 3, 3.5, 4, 3, 2]


def test_its_config_makes_it_again():
    lane = sampled(EXACT[0])
    again = lane_from_config(json.loads(json.dumps(lane.to_config())))
    assert isinstance(again, PolylineLane)
    assert again.position(7.0, 1.0) == pytest.approx(lane.position(7.0, 1.0))
    assert again.to_config() == lane.to_config()
