"""Centre lines and widths of lanes against geometry done by hand."""

import math

import numpy as np
import pytest

from ldrl.towns.opendrive.lanes import LaneKey, sample_road
from ldrl.towns.opendrive.reader import read_opendrive


@pytest.fixture
def sample(xodr, save):
    """Samples of the only road of a map, by section and lane."""

    def sample(geometry, sections, length=40.0, **options):
        source = read_opendrive(save(xodr.opendrive(xodr.road(1, length, geometry, sections, **options))))
        return {(key.section, key.lane): piece for key, piece in sample_road(source.roads["1"]).items()}

    return sample


def line(xodr, length=40.0):
    return xodr.geometry(0, 0, 0, 0, length)


def test_lanes_of_a_bend_lie_on_circles(xodr, sample):
    """A left bend of 20 m radius around (0, 20), two lanes a side; seen with y south it bends to the left too."""
    geometry = xodr.geometry(0, 0, 0, 0, 40, '<arc curvature="0.05"/>')
    lanes = sample(geometry, xodr.section(0, *[xodr.lane(k, 3.0 if abs(k) == 1 else 4.0) for k in (2, 1, -1, -2)]))
    for k, t in ((2, 5.0), (1, 1.5), (-1, -1.5), (-2, -5.0)):
        piece = lanes[0, k]
        radius = np.hypot(piece.points[:, 0], piece.points[:, 1] + 20)
        assert radius == pytest.approx(20 - t)
        assert piece.widths == pytest.approx(3.0 if abs(k) == 1 else 4.0)
        first, last = (piece.points[0], piece.points[-1]) if k < 0 else (piece.points[-1], piece.points[0])
        assert first == pytest.approx((0, -t))
        assert last == pytest.approx(((20 - t) * math.sin(2), (20 - t) * math.cos(2) - 20))
        along = np.diff(piece.points, axis=0)
        middle = (piece.headings[1:] + piece.headings[:-1]) / 2
        assert np.cos(np.arctan2(along[:, 1], along[:, 0]) - middle).min() > 1 - 1e-9  # also: left lanes run back
        assert np.abs(np.diff(piece.points, axis=0)).max() < 0.4


def test_left_hand_traffic_runs_the_other_way(xodr, sample):
    right = sample(line(xodr), xodr.section(0, xodr.lane(1), xodr.lane(-1)))
    left = sample(line(xodr), xodr.section(0, xodr.lane(1), xodr.lane(-1)), rule="LHT")
    for k in (1, -1):
        assert left[0, k].points[::-1] == pytest.approx(right[0, k].points)
    assert right[0, -1].points[0] == pytest.approx((0, 2))  # keeps right: south of its road when it runs east
    assert right[0, -1].points[-1] == pytest.approx((40, 2))
    assert np.cos(left[0, -1].headings) == pytest.approx(-1)


def test_offset_and_widths_are_polynomials(xodr, sample):
    offset = '<laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneOffset s="10" a="0.5" b="0.1" c="-0.002" d="0"/>'
    lanes = sample(
        line(xodr), xodr.section(0, xodr.lane(-1, 3.0, "20 3 0.05 0 0"), xodr.lane(-2, "0 2 0 0.001 0")), offset=offset
    )
    x = lanes[0, -1].points[:, 0]
    inner = np.where(x < 10, 0.5, 0.5 + 0.1 * (x - 10) - 0.002 * (x - 10) ** 2)
    first = np.where(x < 20, 3.0, 3 + 0.05 * (x - 20))
    second = 2 + 0.001 * x**2
    assert lanes[0, -1].widths == pytest.approx(first)
    assert lanes[0, -2].widths == pytest.approx(second)
    assert -lanes[0, -1].points[:, 1] == pytest.approx(inner - first / 2)
    assert -lanes[0, -2].points[:, 1] == pytest.approx(inner - first - second / 2)
    slope = np.gradient(lanes[0, -2].points[:, 1], x)
    assert lanes[0, -2].headings == pytest.approx(np.arctan(slope), abs=0.01)


def test_other_lanes_take_room_but_are_not_driven(xodr, sample):
    kinds = "sidewalk", "driving", "bidirectional", "exit", "none"
    lanes = sample(line(xodr), xodr.section(0, *[xodr.lane(-k - 1, 2.0, kind=kind) for k, kind in enumerate(kinds)]))
    assert {key: piece.points[0, 1] for key, piece in lanes.items()} == {(0, -2): 3.0, (0, -4): 7.0}


def test_sections_meet_and_a_very_short_one_is_passed_over(xodr, sample):
    sections = [xodr.section(s, xodr.lane(-1, 4.0)) for s in (0, 15.1, 15.105)]
    lanes = sample(line(xodr), "".join(sections))
    assert sorted(lanes) == [(0, -1), (2, -1)]
    assert lanes[0, -1].points[-1] == pytest.approx((15.1, 2))
    assert lanes[2, -1].points[0] == pytest.approx((15.105, 2))
    assert lanes[2, -1].points[-1] == pytest.approx((40, 2))


def test_an_opening_lane_leaves_the_one_beside_it(xodr, sample):
    """It opens from 0 to 3 m over 30 m, then keeps its width."""
    lanes = sample(line(xodr), xodr.section(0, xodr.lane(-1, 4.0), xodr.lane(-2, "0 0 0.1 0 0", "30 3 0 0 0")))
    inner, outer = lanes[0, -1], lanes[0, -2]
    assert outer.opens_beside == LaneKey("1", 0, -1)
    assert (outer.closes_beside, inner.opens_beside) == (None, None)
    assert outer.points[0] == pytest.approx(inner.points[0])
    x, y = outer.points.T
    assert y[x >= 30] == pytest.approx(5.5)
    assert (np.diff(y) >= -1e-9).all()
    edge = y + outer.widths / 2
    assert edge == pytest.approx(4 + np.minimum(x / 10, 3))  # where the road ends
    assert (y - outer.widths / 2 >= -1e-9).all()  # never beyond the lane beside it
    assert np.gradient(y, x, edge_order=2) == pytest.approx(np.tan(outer.headings), abs=0.02)


def test_a_closing_lane_joins_the_one_beside_it(xodr, sample):
    """The left side runs against s: what opens in the direction of s closes for the cars."""
    lanes = sample(line(xodr), xodr.section(0, xodr.lane(1, 4.0), xodr.lane(2, "0 0 0.1 0 0", "30 3 0 0 0")))
    outer = lanes[0, 2]
    assert outer.closes_beside == LaneKey("1", 0, 1)
    assert outer.opens_beside is None
    assert outer.points[0] == pytest.approx((40, -5.5))
    assert outer.points[-1] == pytest.approx(lanes[0, 1].points[-1])


def test_lanes_without_width_are_none(xodr, sample):
    lanes = sample(line(xodr), xodr.section(0, xodr.lane(-1, 4.0), xodr.lane(-2, "0 0 0 0 0")))
    assert sorted(lanes) == [(0, -1)]
