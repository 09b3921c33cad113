"""The camera against a ray-by-ray loop, against points that are known, and as either kind of transform."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv

from ldrl import keys
from ldrl.envs import DashCamera, TownEnv
from ldrl.envs.camera import shift
from ldrl.subtasks import MANOEUVRES
from ldrl.towns import Layout, Town
from ldrl.towns.layout import Node
from ldrl.towns.surface import CELL

FORWARD, ABOVE, FOCAL = 1.6, 1.7, 100.0


@pytest.fixture(scope="module")
def square():
    """Streets 100 m long, centre lines on x, y = 0 and 100, 8 m wide and 0.3 m of shoulder on either side."""
    nodes = {"a": Node(0, 0, 8), "b": Node(100, 0, 8), "c": Node(100, 100, 8), "d": Node(0, 100, 8)}
    return Town("square", Layout("square", 4.0, nodes, (("a", "b", "c", "d", "a"),)).network())


def poses_of(town, count, seed=0):
    """Poses on and beside lanes, in junctions too, turned away by up to 0.6 rad."""
    generator = torch.Generator().manual_seed(seed)
    pick = torch.randint(len(town.points), (count,), generator=generator)
    turn, beside = torch.rand(2, count, generator=generator) * 2 - 1
    pose = torch.cat((town.points[pick], town.headings[pick].unsqueeze(-1)), -1)
    return shift(pose, lateral=3 * beside, yaw=0.6 * turn)


def distance_to_road_edge(town, x, y):
    """Read the raster between its cells, one point at a time."""
    raster, origin = town.road_distance[0, 0].numpy(), town.raster_origin.tolist()
    height, width = raster.shape
    column = min(max((x - origin[0]) / CELL, 0.0), width - 1.0)
    row = min(max((y - origin[1]) / CELL, 0.0), height - 1.0)
    j, i = min(int(column), width - 2), min(int(row), height - 2)
    part_x, part_y = column - j, row - i
    upper = raster[i, j] * (1 - part_x) + raster[i, j + 1] * part_x
    lower = raster[i + 1, j] * (1 - part_x) + raster[i + 1, j + 1] * part_x
    return upper * (1 - part_y) + lower * part_y


def image_ray_by_ray(town, pose, lateral=0.0, yaw=0.0):
    """The image, and how far from the edge of the road each ray meets the ground."""
    x, y, heading = map(float, pose)
    x, y = x - lateral * math.sin(heading), y + lateral * math.cos(heading)
    heading += yaw
    x, y = x + FORWARD * math.cos(heading), y + FORWARD * math.sin(heading)
    image, margin = np.zeros((88, 200), np.uint8), np.full((88, 200), math.inf)
    for row in range(88):
        down = (row + 0.5 - 44) / FOCAL
        if down <= 0:
            continue  # at or above the horizon a ray meets no ground
        for column in range(200):
            right, reach = (column + 0.5 - 100) / FOCAL, ABOVE / down
            ahead, aside = reach, reach * right
            ground_x = x + ahead * math.cos(heading) - aside * math.sin(heading)
            ground_y = y + ahead * math.sin(heading) + aside * math.cos(heading)
            distance = distance_to_road_edge(town, ground_x, ground_y)
            image[row, column] = 255 * (distance < 0)
            margin[row, column] = abs(distance)
    return image, margin


@pytest.mark.parametrize(("lateral", "yaw"), [(0.0, 0.0), (0.7, math.radians(-14))])
def test_image_equals_a_ray_by_ray_loop(town, lateral, yaw):
    poses = poses_of(town, 6)
    images = DashCamera(town, lateral=lateral, yaw=yaw).draw(poses)
    for pose, image in zip(poses, images, strict=True):
        expected, margin = image_ray_by_ray(town, pose, lateral, yaw)
        assert 0.05 < (expected[44:] > 0).mean() < 1
        different = image[0].numpy() != expected
        assert not different[margin > 5e-3].any()  # single precision decides on the very edge only
        assert different.mean() < 1e-3


def test_spec_and_values(town1):
    image = DashCamera(town1).draw(poses_of(town1, 3))
    assert image.shape == (3, 1, 88, 200)
    assert image.dtype == torch.uint8
    assert set(image.unique().tolist()) == {0, 255}
    assert not image[:, :, :44].any()  # the sky


def test_edges_of_a_straight_street_meet_their_pixels(square):
    """Eastbound on a street: the right edge lies 2.3 m right of the lane's centre, the left one 6.3 m left of it."""
    image = DashCamera(square).draw(torch.tensor([50.0, 2.0, 0.0]))[0]
    for row in range(60, 88):  # near enough that the street's end is out of sight
        reach = ABOVE / ((row + 0.5 - 44) / FOCAL)
        left, right = 100 - FOCAL * 6.3 / reach, 100 + FOCAL * 2.3 / reach
        expected = torch.tensor([255 * (left < column + 0.5 < right) for column in range(200)], dtype=torch.uint8)
        clear = torch.tensor([min(abs(column + 0.5 - left), abs(column + 0.5 - right)) > 0.2 for column in range(200)])
        assert (image[row] == expected)[clear].all(), row


def test_curb_ahead_meets_its_row(square):
    """Facing the far curb of a street at right angles: 10 m ahead of the camera the road ends."""
    for ahead in (5.0, 10.0, 25.0):
        pose = torch.tensor([50.0, 4.3 - ahead - FORWARD, math.pi / 2])
        image = DashCamera(square).draw(pose)[0]
        horizon_to_curb = FOCAL * ABOVE / ahead
        column = image[44:, 100]
        first = int((column > 0).int().argmax())
        assert first == math.ceil(horizon_to_curb - 0.5), ahead


@pytest.mark.parametrize(("lateral", "yaw"), [(1.0, 0.0), (-0.5, math.radians(14)), (0.0, math.radians(-14))])
def test_mount_equals_a_moved_car(town2, lateral, yaw):
    poses = poses_of(town2, 20)
    x, y, heading = poses.unbind(-1)
    moved = torch.stack((x - lateral * heading.sin(), y + lateral * heading.cos(), heading + yaw), -1)
    mounted = DashCamera(town2, lateral=lateral, yaw=yaw).draw(poses)
    assert torch.equal(mounted, DashCamera(town2).draw(moved))
    assert not torch.equal(mounted, DashCamera(town2).draw(poses))


def test_to_the_right_is_to_the_right(square):
    """A camera further right sees less road on its right."""
    pose = torch.tensor([50.0, 2.0, 0.0])
    seen = [DashCamera(square, lateral=d).draw(pose)[0, 80, 100:].count_nonzero() for d in (-1.0, 0.0, 1.0)]
    assert seen[0] > seen[1] > seen[2]


def test_a_batch_row_equals_a_run_of_one(town2):
    poses = poses_of(town2, 130)  # more than are drawn at once
    camera = DashCamera(town2)
    images = camera.draw(poses)
    assert all(torch.equal(images[k], camera.draw(poses[k])) for k in range(0, 130, 7))
    assert torch.equal(images, camera.draw(poses.view(13, 10, 3)).view(130, 1, 88, 200))
    assert camera.draw(poses[:0]).shape == (0, 1, 88, 200)


def test_env_and_replay_buffer_draw_the_same(town2):
    env = TransformedEnv(TownEnv(town2, 4, seed=0), DashCamera(town2))
    rollout = env.rollout(6, break_when_any_done=False).reshape(-1)
    assert not rollout[keys.IMAGE].flatten(1).eq(rollout[keys.IMAGE].flatten(1)[0]).all()
    stored = rollout.select(keys.POSE)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(24), batch_size=24, transform=DashCamera(town2))
    buffer.extend(stored)
    assert torch.equal(buffer[:][keys.IMAGE], rollout[keys.IMAGE])
    sampled = buffer.sample()
    assert torch.equal(sampled[keys.IMAGE], DashCamera(town2).draw(sampled[keys.POSE]))
    windows = DashCamera(town2)(TensorDict({keys.POSE: stored[keys.POSE].view(4, 6, 3)}, [4, 6]))
    assert torch.equal(windows[keys.IMAGE].view(24, 1, 88, 200), rollout[keys.IMAGE])


def test_images_follow_resets(town2):
    env = TransformedEnv(TownEnv(town2, 3, seed=0), DashCamera(town2))
    td = env.reset()
    again = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert not torch.equal(again[keys.POSE][1], td[keys.POSE][1])
    assert torch.equal(again[keys.IMAGE], DashCamera(town2).draw(again[keys.POSE]))
    assert torch.equal(again[keys.IMAGE][[0, 2]], td[keys.IMAGE][[0, 2]])


def test_junctions_are_road(town1):
    lane = next(i for i in range(len(town1.lane_length)) if town1.lane_manoeuvre[i] in MANOEUVRES)
    first = int(town1.lane_first[lane])
    pose = torch.cat((town1.points[first], town1.headings[first : first + 1]))
    assert (DashCamera(town1).draw(pose)[0, 87, 80:120] == 255).all()
