"""Curves of OpenDRIVE against exact and numerical references."""

import math

import numpy as np
import pytest

from ldrl.towns.opendrive.geometry import Clothoid, Geometry, Parametric, cubic, reference_line


def walk(x, y, heading, curvature, length, steps=20_000):
    """The end of a curve of given curvature, in many short steps (midpoint rule)."""
    ds = length / steps
    s = (np.arange(steps) + 0.5) * ds
    turned = heading + np.cumsum(curvature(s)) * ds - curvature(s) * ds / 2
    return x + (np.cos(turned) * ds).sum(), y + (np.sin(turned) * ds).sum(), heading + curvature(s).sum() * ds


def test_line():
    x, y, heading = Clothoid(30.0).poses(np.array([0.0, 7.5, 30.0]))
    assert x == pytest.approx([0, 7.5, 30])
    assert y == pytest.approx([0, 0, 0])
    assert heading == pytest.approx([0, 0, 0])


@pytest.mark.parametrize("curvature", [0.1, -0.04])
def test_arc_lies_on_its_circle(curvature):
    u = np.arange(0, 25, 0.25)
    x, y, heading = Clothoid(25.0, curvature, curvature).poses(u)
    assert x == pytest.approx(np.sin(curvature * u) / curvature, abs=1e-9)
    assert y == pytest.approx((1 - np.cos(curvature * u)) / curvature, abs=1e-9)
    assert heading == pytest.approx(curvature * u)


def test_spiral_is_fresnels():
    x, y, heading = Clothoid(1.0, 0.0, math.pi).poses(np.linspace(0, 1, 5))
    assert x[-1] == pytest.approx(0.7798934003768228, abs=1e-12)  # C(1)
    assert y[-1] == pytest.approx(0.4382591473903548, abs=1e-12)  # S(1)
    assert heading[-1] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(("start", "end"), [(0.0, 0.1), (0.1, 0.0), (-0.05, 0.08), (0.02, 0.02)])
def test_spiral_from_any_to_any_curvature(start, end):
    u = np.arange(0, 40.25, 0.25)
    x, y, heading = Clothoid(40.0, start, end).poses(u)
    for k in (1, 60, 160):
        expected = walk(0, 0, 0, lambda s: start + (end - start) * s / 40, u[k])
        assert (x[k], y[k], heading[k]) == pytest.approx(expected, abs=1e-5)


def test_poly3_by_arc_length():
    curve = Parametric(50.0, (0, 1), (0, 0, 0.01, 0.0002), None)
    dense = np.linspace(0, 50, 200_001)
    v = 0.01 * dense**2 + 0.0002 * dense**3
    arc = np.concatenate(([0], np.hypot(np.diff(dense), np.diff(v)).cumsum()))
    s = np.array([0.0, 1.0, 20.0, 50.0])
    x, y, heading = curve.poses(s)
    u = np.interp(s, arc, dense)
    assert u[-1] < 40  # far shorter than the arc
    assert x == pytest.approx(u, abs=1e-3)
    assert y == pytest.approx(0.01 * u**2 + 0.0002 * u**3, abs=1e-3)
    assert heading == pytest.approx(np.arctan(0.02 * u + 0.0006 * u**2), abs=1e-4)


@pytest.mark.parametrize("normalized", [True, False])
def test_param_poly3_in_both_forms(normalized):
    """A Bezier quarter of a circle, which it meets within 0.03%; ``p`` from 0 to 1 or to its length."""
    radius, c = 20.0, 0.5522847498
    length = radius * math.pi / 2 * 1.0000273
    last = 1.0 if normalized else length
    u = radius * np.array([0, 3 * c, 3 - 6 * c, 3 * c - 2]) / last ** np.arange(4)
    v = radius * np.array([0, 0, 3 - 3 * c, 3 * c - 2]) / last ** np.arange(4)
    s = np.linspace(0, length, 9)
    x, y, heading = Parametric(length, u, v, last).poses(s)
    angle = s / radius
    assert x == pytest.approx(radius * np.sin(angle), abs=0.02)
    assert y == pytest.approx(radius * (1 - np.cos(angle)), abs=0.02)
    assert heading == pytest.approx(angle, abs=2e-3)
    assert (x[-1], y[-1]) == pytest.approx((radius, radius))


def test_a_curve_that_stands_still_is_refused():
    with pytest.raises(ValueError, match="stands still; check its coefficients"):
        Parametric(10.0, [3.0, 0, 0, 0], [0.0] * 4, 1.0).poses(np.array([0.0, 10.0]))


def test_cubic_pieces():
    records = np.array([[2.0, 1, 2, 3, 4], [5.0, 7, 0, 0, 0]])
    assert cubic(records, np.array([0.0, 2.0, 4.0, 5.0, 99.0])).tolist() == [0, 1, 1 + 4 + 12 + 32, 7, 7]
    assert cubic(np.empty((0, 5)), np.array([1.0, 2.0])).tolist() == [0, 0]


def test_reference_line_joins_its_pieces():
    quarter = 5 * math.pi
    line = (
        Geometry(0.0, 3.0, 4.0, math.pi / 2, Clothoid(10.0)),
        Geometry(10.0, 3.0, 14.0, math.pi / 2, Clothoid(quarter, 0.1, 0.1)),
        Geometry(10.0 + quarter, -7.0, 24.0, -math.pi, Clothoid(5.0)),  # the same direction, a turn further back
    )
    x, y, heading = reference_line(line, np.array([0.0, 4.0, 10.0, 10 + quarter / 2, 10 + quarter, 12 + quarter]))
    half = 10 * math.sqrt(0.5)
    assert x == pytest.approx([3, 3, 3, -7 + half, -7, -9])
    assert y == pytest.approx([4, 8, 14, 14 + half, 24, 24])
    right = math.pi / 2
    assert heading == pytest.approx([right, right, right, 1.5 * right, 2 * right, 2 * right])
