"""The rgb view above the horizon against a loop over rays, and cars one behind the other."""

import math

import numpy as np
import pytest
import torch

from ldrl.envs import DashCamera
from ldrl.envs.appearance import BANDS, CAR_COLOURS, CAR_PARTS, CODES, PARTS, Code
from ldrl.envs.sight import ABOVE, FOCAL, FORWARD
from ldrl.towns.surface import CELL

SKY, WALL, STEM, CROWN = range(4)
CLASSES = torch.full((CODES,), WALL)
CLASSES[Code.SKY : Code.TRUNK] = SKY
CLASSES[Code.TRUNK : Code.FOLIAGE] = STEM
CLASSES[Code.FOLIAGE : Code.CAR] = CROWN


def codes_of(town, pose, traffic=None):
    """The colour code of every pixel: what a look shows in which each code is its own colour."""
    camera = DashCamera(town, modality="rgb")
    camera.colours = torch.arange(CODES, dtype=torch.int32).repeat(BANDS).unsqueeze(0)
    return camera.draw(pose, traffic)[..., 0, :, :].long()


def class_of_ray(town, x, y, cos, sin, column, row):
    """What the ray through a pixel above the horizon meets first, by small steps and over all props."""
    scenery = town.scenery
    right, up = (column + 0.5 - 100) / FOCAL, (44 - row - 0.5) / FOCAL
    depth = 1.5 * 1.005 ** np.arange(900)
    depth = depth[depth < 115]
    j = (x + depth * (cos - right * sin) - float(scenery.corner[0])) / CELL
    i = (y + depth * (sin + right * cos) - float(scenery.corner[1])) / CELL
    inside, height = scenery.walls[0].numpy()
    i, j = np.clip(i, 0, len(inside) - 1).astype(int), np.clip(j, 0, inside.shape[1] - 1).astype(int)
    hits = depth[(inside[i, j] > 0) & (height[i, j] >= ABOVE + up * depth)]
    nearest, found = (hits[0], WALL) if len(hits) else (math.inf, SKY)
    px, py, stem, radius, bottom, top = scenery.props.numpy().T
    ahead, aside = (px - x) * cos + (py - y) * sin, (py - y) * cos - (px - x) * sin
    off = np.abs(ahead * right - aside)
    half = (top - bottom) / 2 * np.sqrt(np.clip(1 - (off / radius) ** 2, 0, None))
    above = ABOVE + up * ahead - (top + bottom) / 2
    for kind, seen in ((CROWN, (off < radius) & (np.abs(above) < half)), (STEM, (off < stem) & (above < -half))):
        depths = ahead[seen & (ahead > 0.5) & (ahead < nearest)]
        if len(depths):
            nearest, found = depths.min(), kind
    return found


def test_above_the_horizon_the_nearest_thing_is_drawn(town):
    expected, drawn = [], []
    for lane in town.approaches()[::9]:
        start, heading = town.sample(torch.tensor([[lane] * 6]), torch.tensor([[float(town.lane_length[lane]) - 12]]))
        pose = torch.cat((start[0, 0], heading[0]))
        codes, (x, y, heading) = codes_of(town, pose), pose.tolist()
        cos, sin = math.cos(heading), math.sin(heading)
        for row in range(1, 44, 3):
            for column in range(2, 200, 5):
                ray = (x + FORWARD * cos, y + FORWARD * sin, cos, sin, column, row)
                expected.append(class_of_ray(town, *ray))
                drawn.append(int(CLASSES[codes[row, column]]))
    expected, drawn = np.array(expected), np.array(drawn)
    # Slivers of buildings and of trees in a row are missed, and edges are a pixel off.
    for kind, share in ((SKY, 0.82), (WALL, 0.88), (CROWN, 0.9), (STEM, 0.6)):
        assert (expected == kind).sum() > 5
        assert (drawn[expected == kind] == kind).mean() > share, kind
        assert (expected[drawn == kind] == kind).mean() > share, kind


def test_facades_have_windows_above_a_ground_floor(town1):
    lane = town1.approaches()[0]
    start, heading = town1.sample(torch.tensor([[lane] * 6]), torch.tensor([[20.0]]))
    codes = codes_of(town1, torch.cat((start[0, 0], heading[0])))[:44]
    facade = (codes >= Code.FACADE) & (codes < Code.SKY)
    part = (codes - Code.FACADE) % PARTS
    shares = [(part[facade] == k).float().mean() for k in range(PARTS)]
    assert min(shares) > 0.03
    rows = torch.arange(44).unsqueeze(1).expand_as(codes)
    assert rows[facade & (part == 2)].float().mean() > rows[facade & (part == 1)].float().mean()  # lower in the picture


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_car_hides_the_farther_one(town1, order):
    pose = torch.tensor([200.0, 2.0, math.pi])
    ahead = [9.0, 20.0]
    cars = torch.tensor([[200.0 - ahead[k], 2.0, math.pi, 0.0] for k in order])
    codes = codes_of(town1, pose, cars)[44:]
    colour = (codes[codes >= Code.CAR] - Code.CAR) // CAR_PARTS
    assert (codes[12:24, 100] >= Code.CAR).all()
    assert ((codes[12:24, 100] - Code.CAR) // CAR_PARTS == order.index(0) % CAR_COLOURS).all()
    assert set(colour.tolist()) <= {0, 1}


def test_cars_beside_the_view_do_not_push_out_one_in_it(town1):
    pose = torch.tensor([200.0, 2.0, math.pi])
    beside = [[199.0 - 0.1 * k, 2.0 + (20 + k) * (-1) ** k, math.pi, 0.0] for k in range(12)]
    car = [[185.0, 2.0, math.pi, 0.0]]
    camera = DashCamera(town1)
    assert torch.equal(camera.draw(pose, torch.tensor(beside + car)), camera.draw(pose, torch.tensor(car)))
    assert not torch.equal(camera.draw(pose, torch.tensor(car)), camera.draw(pose))
    assert torch.equal(camera.draw(pose, torch.zeros(0, 4)), camera.draw(pose))
