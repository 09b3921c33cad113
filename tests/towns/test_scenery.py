"""The ground against geometry, what stands on it, and that it depends on the town and the seed only."""

import math
from itertools import pairwise

import pytest
import torch
from highway_env.road.lane import CircularLane
from highway_env.road.road import RoadNetwork

from ldrl.subtasks import SubTask
from ldrl.towns import Town
from ldrl.towns.ground import SIDEWALK, TEXELS, Material
from ldrl.towns.noise import hash_uniform
from ldrl.towns.scenery import NEARBY, PROP_CELL, STYLES, Scenery
from ldrl.towns.surface import CELL, sample

TEXEL = CELL / TEXELS


def ground_at(scenery, x, y):
    column, row = ((torch.stack((x, y)) - scenery.corner.unsqueeze(-1)) / TEXEL).long()
    return scenery.ground()[row, column]


def test_hash_uniform():
    numbers = hash_uniform(torch.arange(20_000), 3)
    assert numbers.min() >= 0
    assert numbers.max() < 1
    assert torch.histc(numbers, 10, 0, 1).sub(2000).abs().max() < 200
    assert numbers[:-1].sub(0.5).mul(numbers[1:] - 0.5).mean().abs() < 2e-3  # neighbours are unlike
    assert torch.equal(numbers, hash_uniform(torch.arange(20_000), 3))
    assert not torch.equal(numbers, hash_uniform(torch.arange(20_000), 4))
    assert not torch.equal(numbers, hash_uniform(3, torch.arange(20_000)))


def test_lines_of_a_street(square):
    """Across the street at x = 50: edge lines 4 m from the centre line, the kerb at 4.3 m, then the sidewalk."""
    y = torch.arange(-9, 9, TEXEL) + TEXEL / 2
    across = torch.stack([ground_at(square.scenery, torch.full_like(y, x), y) for x in torch.arange(45, 57, TEXEL)])
    at = {kind: y[(across == kind).sum(0) > 10].abs() for kind in Material}
    assert (at[Material.EDGE_LINE] - 4).abs().max() < 0.2
    assert at[Material.CENTRE_LINE].max() < 0.2
    assert (at[Material.KERB] - 4.4).abs().max() < 0.2
    walk = (across >= Material.SIDEWALK) & (across < Material.GRASS)
    beside = (y.abs() > 4.6) & (y.abs() < 6.9)
    assert walk[:, beside].all()
    assert not walk[:, ~beside & ((y.abs() < 4.4) | (y.abs() > 7.2))].any()


def test_the_centre_line_is_dashed(square):
    x = torch.arange(20, 80, TEXEL)
    line = ground_at(square.scenery, x, torch.full_like(x, 0.05))
    dash, gap = (line == Material.CENTRE_LINE).float().mean(), (line == Material.CENTRE_GAP).float().mean()
    assert dash == pytest.approx(0.47, abs=0.06)  # three of six metres, worn here and there
    assert gap == pytest.approx(0.47, abs=0.06)
    changes = (line == Material.CENTRE_GAP).int().diff().abs().sum()
    assert changes >= 15


def test_lanes_side_by_side_are_divided_by_dashes():
    network = RoadNetwork()
    quarters = [k * math.pi / 2 for k in range(5)]
    for k, (start, end) in enumerate(pairwise(quarters)):
        for radius in (34.0, 30.0):
            lane = CircularLane((0, 0), radius, start, end, clockwise=True, width=4.0)
            lane.manoeuvre = SubTask.LANEFOLLOW
            network.add_lane(str(k), str((k + 1) % 4), lane)
    scenery = Town("ring", network).scenery
    angle = torch.arange(0, 2 * math.pi, 0.002)
    line = ground_at(scenery, 32 * angle.cos(), 32 * angle.sin())
    assert (line == Material.LANE_LINE).float().mean() == pytest.approx(0.4, abs=0.12)
    edge = ground_at(scenery, 36 * angle.cos(), 36 * angle.sin())
    assert (edge == Material.EDGE_LINE).float().mean() > 0.5


def test_some_of_the_road_is_patched(town):
    ground = town.scenery.ground()
    road, patch = ground <= Material.STOP_LINE, (ground >= Material.PATCH) & (ground < Material.EDGE_LINE)
    assert 0.01 < patch.sum() / road.sum() < 0.1


def test_stop_lines_and_no_lines_in_junctions(town2):
    scenery = town2.scenery
    for lane in town2.approaches():
        end = town2.points[town2.lane_first[lane] + 1 : town2.lane_first[lane] + 2]
        last = town2.lane_first[lane] + round(float(town2.lane_length[lane] / town2.lane_spacing[lane]))
        point, heading = town2.points[last], town2.headings[last]
        spot = point - 0.25 * torch.stack((heading.cos(), heading.sin()))
        found = ground_at(scenery, spot[:1] + torch.linspace(-0.4, 0.4, 5), spot[1:] + torch.zeros(5))
        assert (found == Material.STOP_LINE).any(), lane
        assert not (ground_at(scenery, end[:, 0], end[:, 1]) == Material.STOP_LINE).any()
    junction = (town2.lane_manoeuvre != 3).nonzero().squeeze(-1)
    for lane in junction.tolist():
        first, count = int(town2.lane_first[lane]), round(float(town2.lane_length[lane] / town2.lane_spacing[lane]))
        inner = town2.points[first + 3 : first + count - 3]
        assert (ground_at(scenery, inner[:, 0], inner[:, 1]) <= Material.PATCH + 1).all()


def test_buildings_stand_behind_the_sidewalk(town):
    scenery = town.scenery
    rows, columns = (scenery.ground() == Material.WALL).nonzero()[::97].unbind(-1)
    spots = torch.stack((columns, rows), -1) * TEXEL + TEXEL / 2 + scenery.corner
    beyond = sample(town.road_distance, town.raster_origin, spots).squeeze(-1)
    assert beyond.min() > SIDEWALK
    along_street = (beyond < 7).float().mean()
    assert along_street > 0.1  # close enough to make streets of them
    height = scenery.walls[0, 1][scenery.walls[0, 0] > 0]
    assert height.min() >= 3
    assert height.max() < 30
    assert scenery.facade.max() <= STYLES


def test_trees_and_posts_stand_beside_the_road(town):
    props = town.scenery.props
    beyond = sample(town.road_distance, town.raster_origin, props[:, :2]).squeeze(-1)
    assert len(props) > 100
    assert beyond.min() > 2.5
    assert (props[:, 2] < props[:, 3]).all()
    assert (props[:, 4] < props[:, 5]).all()


def test_nearby_are_the_nearest(town2):
    scenery = town2.scenery
    for row, column in ((3, 4), (10, 20), (25, 7)):
        centre = scenery.corner + (torch.tensor([column, row]) + 0.5) * PROP_CELL
        distance = (scenery.props[:, :2] - centre).norm(dim=-1)
        found = scenery.nearby[row, column]
        assert distance[found].max() <= distance.sort().values[NEARBY - 1] + 1e-4
        assert (distance[found].diff() >= -1e-4).all()


def test_depends_on_town_and_seed_only(square):
    def tensors(scenery):
        return dict(scenery.named_buffers())

    again, other = Scenery(square), Town("square", square.network, seed=1).scenery
    elsewhere = Town("maps/square", square.network).scenery
    assert torch.equal(elsewhere.pyramid, again.pyramid)
    assert all(torch.equal(value, tensors(again)[name]) for name, value in tensors(square.scenery).items())
    assert not torch.equal(other.ground(), again.ground())
    road = again.ground() <= Material.STOP_LINE
    assert torch.equal(other.ground() <= Material.STOP_LINE, road)
    assert square.scenery is square.scenery
