"""The rasters against geometry, and reading them."""

import math

import pytest
import torch

from ldrl.towns.surface import CELL, MARGIN, rasterise, sample

HALF_WIDTH, SPACING = 2.3, 0.5


def street(length=40.0):
    x = torch.arange(0, length + SPACING, SPACING)
    return torch.stack((x, torch.zeros_like(x)), -1), torch.zeros_like(x)


def bend(radius=10.0):
    """A quarter circle around the origin, from north to east, clockwise."""
    angle = torch.linspace(-math.pi / 2, 0, math.ceil(radius * math.pi / 2 / SPACING) + 1)
    return radius * torch.stack((angle.cos(), angle.sin()), -1), angle + math.pi / 2


def surface_of(points, headings, half_width=HALF_WIDTH):
    return rasterise(points, headings, half_width * torch.ones_like(headings), SPACING)


def read(surface, positions):
    return sample(surface.road_distance, surface.origin, positions).squeeze(-1)


def test_distance_on_a_straight_street():
    surface = surface_of(*street())
    y = torch.linspace(-9, 9, 37)
    for shift in (0.0, 0.07, 0.21):
        positions = torch.stack((20 + 0.13 * y, y + shift), -1)
        expected = (positions[:, 1].abs() - HALF_WIDTH).clamp(max=MARGIN)
        assert read(surface, positions)[y.abs() > 1].tolist() == pytest.approx(expected[y.abs() > 1].tolist(), abs=1e-3)
        # on the centre line, where the distance has its crest, it is interpolated between two cells
        torch.testing.assert_close(read(surface, positions), expected, atol=CELL / 2, rtol=0)


def test_distance_on_a_bend():
    surface = surface_of(*bend())
    angle = torch.linspace(-1.3, -0.2, 12)
    for radius in (5.0, 7.69, 9.0, 11.5, 12.31, 15.0):
        positions = radius * torch.stack((angle.cos(), angle.sin()), -1)
        expected = torch.full_like(angle, abs(radius - 10) - HALF_WIDTH)
        torch.testing.assert_close(read(surface, positions), expected, atol=0.03, rtol=0)


def test_the_road_is_the_union_of_its_lanes():
    (first, headings), (second, turned) = street(), bend()
    both = surface_of(torch.cat((first, second)), torch.cat((headings, turned)))
    positions = torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) * 30 - 10
    separate = [read(surface_of(*lane), positions) for lane in (street(), bend())]
    torch.testing.assert_close(read(both, positions), torch.minimum(*separate), atol=0.3, rtol=0)


def test_width_may_change_along_a_street():
    points, headings = street()
    surface = surface_of(points, headings, torch.linspace(1.0, 3.0, len(points)))
    x = torch.linspace(2, 38, 37)
    half_width = 1 + x / 20
    for beyond in (-0.4, 0.0, 0.6, 3.0):
        distance = read(surface, torch.stack((x, half_width + beyond), -1))
        # across the street, not at right angles to its slanting edge
        torch.testing.assert_close(distance, torch.full_like(x, beyond), atol=0.03, rtol=0)


def test_of_two_bands_the_one_that_is_deeper_owns_a_cell():
    points, headings = street()
    wide, narrow = points + torch.tensor([0.0, 4.0]), points - torch.tensor([0.0, 1.0])
    half_width = torch.cat((torch.full_like(headings, 4.0), torch.full_like(headings, 1.0)))  # they touch at y = 0
    surface = surface_of(torch.cat((wide, narrow)), torch.cat((headings, headings)), half_width)
    row = ((torch.tensor([1.0, -0.6]) - surface.origin[1]) / CELL).round().long()
    column = int(((20 - surface.origin[0]) / CELL).round())
    # y = 1 is 3 m from the wide lane's centre and 2 m from the narrow one's, but beyond the edge of that one
    assert (surface.nearest_point[row, column] < len(points)).tolist() == [True, False]


def test_a_surface_too_large_is_refused():
    points = torch.tensor([[0.0, 0.0], [3000.0, 2000.0]])
    with pytest.raises(ValueError, match=r"the map covers 3\.0 by 2\.0 km; cut it to an area of 4 square kilometres"):
        surface_of(points, torch.zeros(2))


def test_nearest_point_is_nearest():
    points = torch.cat((street()[0], bend()[0]))
    headings = torch.cat((street()[1], bend()[1]))
    surface = surface_of(points, headings)
    i, j = torch.meshgrid(*map(torch.arange, surface.nearest_point.shape), indexing="ij")
    centres = torch.stack((j, i), -1) * CELL + surface.origin
    gap = (centres - points[surface.nearest_point]).norm(dim=-1)
    least = torch.cdist(centres.view(-1, 2), points).amin(-1).view_as(gap)
    within = surface.road_distance[0, 0] < 4
    assert within.sum() > 1000
    assert (gap - least)[within].max() < SPACING / 2


def test_reading_outside_gives_the_border():
    surface = surface_of(*street())
    far = torch.tensor([[1000.0, 0.0], [-1000.0, 500.0], [20.0, -1e4]])
    assert read(surface, far).tolist() == pytest.approx([MARGIN, MARGIN, MARGIN], abs=0.3)


def test_reading_modes_and_shapes():
    raster = torch.arange(12.0).view(1, 1, 3, 4).repeat(1, 2, 1, 1)
    raster[:, 1] *= -1
    origin = torch.tensor([10.0, 20.0])
    position = torch.tensor([[[10.0, 20.0], [10.0 + 0.7 * CELL, 20.0 + CELL]]])
    assert sample(raster, origin, position).shape == (1, 2, 2)
    assert sample(raster, origin, position)[0, :, 0].tolist() == pytest.approx([0.0, 4.7])
    assert sample(raster, origin, position, "nearest")[0].flatten().tolist() == pytest.approx([0, 0, 5, -5])
