"""The camera against a ray-by-ray loop, against points that are known, and as either kind of transform."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from ldrl import keys
from ldrl.envs import DashCamera, TownEnv, painting
from ldrl.envs.appearance import CODES, WEATHERS
from ldrl.envs.camera import shift
from ldrl.envs.sight import COARSER, Mount
from ldrl.subtasks import MANOEUVRES
from ldrl.towns.ground import TEXELS, Material
from ldrl.towns.surface import CELL, sample

TEXEL = CELL / TEXELS
FORWARD, ABOVE, FOCAL = 1.6, 1.7, 100.0


def poses_of(town, count, seed=0):
    """Poses on and beside lanes, in junctions too, turned away by up to 0.6 rad."""
    generator = torch.Generator().manual_seed(seed)
    pick = torch.randint(len(town.points), (count,), generator=generator)
    turn, beside = torch.rand(2, count, generator=generator) * 2 - 1
    pose = torch.cat((town.points[pick], town.headings[pick].unsqueeze(-1)), -1)
    return shift(pose, lateral=3 * beside, yaw=0.6 * turn)


def image_ray_by_ray(town, pose, lateral=0.0, yaw=0.0):
    """The image by walking along each ray in small steps."""
    scenery = town.scenery
    ground, corner = scenery.ground().numpy(), scenery.corner.tolist()
    x, y, heading = map(float, pose)
    x, y = x - lateral * math.sin(heading), y + lateral * math.cos(heading)
    heading += yaw
    x, y = x + FORWARD * math.cos(heading), y + FORWARD * math.sin(heading)
    cos, sin = math.cos(heading), math.sin(heading)
    props = scenery.props.numpy()
    ahead = (props[:, 0] - x) * cos + (props[:, 1] - y) * sin
    aside = (props[:, 1] - y) * cos - (props[:, 0] - x) * sin
    steps = 1.0 * 1.01 ** np.arange(600)
    image = np.zeros((88, 200), np.uint8)

    def texel(depth, right):
        column = (x + depth * cos - depth * right * sin - corner[0]) / TEXEL
        row = (y + depth * sin + depth * right * cos - corner[1]) / TEXEL
        return ground[np.clip(row, 0, len(ground) - 1).astype(int), np.clip(column, 0, ground.shape[1] - 1).astype(int)]

    for column in range(200):
        right = (column + 0.5 - 100) / FOCAL
        stems = (np.abs(ahead * right - aside) < props[:, 2]) & (ahead > 0.5)
        walls = (texel(steps, right) == Material.WALL) & (steps < 120)
        obstacle = min(np.min(ahead[stems], initial=math.inf), np.min(steps[walls], initial=math.inf))
        for row in range(44, 88):  # at or above the horizon a ray meets no ground
            reach = ABOVE / ((row + 0.5 - 44) / FOCAL)
            image[row, column] = 255 * (texel(np.float64(reach), right) <= Material.STOP_LINE and reach < obstacle)
    return image


@pytest.mark.parametrize(("lateral", "yaw"), [(0.0, 0.0), (0.7, math.radians(-14))])
def test_image_equals_a_ray_by_ray_loop(town, lateral, yaw):
    poses = poses_of(town, 4)
    images = DashCamera(town, lateral=lateral, yaw=yaw).draw(poses)
    for pose, image in zip(poses, images, strict=True):
        expected = image_ray_by_ray(town, pose, lateral, yaw)
        assert 0.05 < (expected[44:] > 0).mean() < 1
        different = image[0].numpy() != expected
        assert different.sum() <= 24  # corners of walls that lie between two depths, and edges in coarser texels
        assert different[44 + round(FOCAL * ABOVE / COARSER[0]) :].sum() <= 6


def test_the_road_in_the_image_is_the_road_that_is_driven_on(square):
    """The texels that the camera reads agree with the raster that tells whether a car is off the road."""
    scenery = square.scenery
    height, width = scenery.ground().shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    spots = torch.stack((x, y), -1).view(-1, 2)[::7] * TEXEL + TEXEL / 2 + scenery.corner
    distance = sample(square.road_distance, square.raster_origin, spots).squeeze(-1)
    road = scenery.ground().view(-1)[::7] <= Material.STOP_LINE
    clear = distance.abs() > TEXEL
    assert torch.equal(road[clear], (distance < 0)[clear])
    assert 0.05 < road.float().mean() < 0.5


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
        texel = TEXEL / reach * FOCAL  # as wide as it looks there
        clear = torch.tensor(
            [min(abs(column + 0.5 - left), abs(column + 0.5 - right)) > texel for column in range(200)]
        )
        assert (image[row] == expected)[clear].all(), row


def test_curb_ahead_meets_its_row(square):
    """Facing the far curb of a street at right angles: 10 m ahead of the camera the road ends."""
    for ahead in (5.0, 8.0, 12.0):
        pose = torch.tensor([50.0, 4.3 - ahead - FORWARD, math.pi / 2])
        image = DashCamera(square).draw(pose)[0]
        horizon_to_curb = FOCAL * ABOVE / ahead
        column = image[44:, 100]
        first = int((column > 0).int().argmax())
        assert abs(first - (horizon_to_curb - 0.5)) < 1.1, ahead


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


@pytest.mark.parametrize("modality", ["gs", "rgb"])
def test_a_batch_row_equals_a_run_of_one(town2, modality):
    poses = poses_of(town2, 70)  # more than are drawn at once
    camera = DashCamera(town2, modality=modality)
    images = camera.draw(poses)
    assert all(torch.equal(images[k], camera.draw(poses[k])) for k in range(70))
    assert torch.equal(images, camera.draw(poses.view(7, 10, 3)).flatten(0, 1))
    assert camera.draw(poses[:0]).shape == (0, *images.shape[1:])


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


@pytest.mark.parametrize("appearance", ["clear", "episode"])
def test_only_cars_that_move_see(town2, appearance, monkeypatch):
    def env():
        return TransformedEnv(TownEnv(town2, 4, seed=0), DashCamera(town2, modality="rgb", appearance=appearance))

    some, every = env(), env()
    td = every.rand_action(every.reset())
    action, moves = td[keys.ACTION], torch.tensor([True, False, False, True])
    expected = every.step(td)["next"]
    drawn, draw = [], DashCamera.draw
    monkeypatch.setattr(DashCamera, "draw", lambda self, *given: drawn.append(len(given[0])) or draw(self, *given))
    found = some.step(some.reset().set(keys.ACTION, action).set("_step", moves))["next"]
    assert drawn == [4, 2]
    assert torch.equal(found[keys.IMAGE][moves], expected[keys.IMAGE][moves])
    assert not found[keys.IMAGE][~moves].any()
    if appearance == "episode":
        assert torch.equal(found[keys.APPEARANCE], expected[keys.APPEARANCE])


def test_junctions_are_road(town1):
    lane = next(i for i in range(len(town1.lane_length)) if town1.lane_manoeuvre[i] in MANOEUVRES)
    first = int(town1.lane_first[lane])
    pose = torch.cat((town1.points[first], town1.headings[first : first + 1]))
    assert (DashCamera(town1).draw(pose)[0, 87, 80:120] == 255).all()


def road_only(town):
    """An rgb camera in whose look the road is white, and all else is black."""
    camera = DashCamera(town, modality="rgb")
    road = (torch.arange(CODES) <= Material.STOP_LINE).int() * 0xFFFFFF
    camera.colours = road.repeat(len(camera.colours[0]) // CODES).unsqueeze(0)
    return camera


def traffic_around(poses, count=6, seed=0):
    """Cars 5 to 35 m ahead and up to 8 m aside, turned anyhow; the last row holds none."""
    generator = torch.Generator().manual_seed(seed)
    ahead, aside, turn = torch.rand(3, len(poses), count, generator=generator)
    x, y, heading = poses.unsqueeze(1).unbind(-1)
    ahead, aside = 5 + 30 * ahead, 16 * aside - 8
    x, y = x + ahead * heading.cos() - aside * heading.sin(), y + ahead * heading.sin() + aside * heading.cos()
    cars = torch.stack((x, y, heading + 6.3 * turn, torch.zeros_like(turn)), -1)
    cars[:, -1] = torch.nan
    return cars


@pytest.mark.parametrize("with_traffic", [False, True])
def test_road_of_rgb_is_gs(town, with_traffic):
    poses = poses_of(town, 70)
    traffic = traffic_around(poses) if with_traffic else None
    gs, rgb = DashCamera(town).draw(poses, traffic), road_only(town).draw(poses, traffic)
    assert torch.equal(rgb, gs.expand(-1, 3, -1, -1))
    assert 0.05 < gs.float().mean() / 255 < 0.5


def test_cars_hide_what_is_behind_them(square):
    """Against a ray and a box in space, for a car that stands askew on the empty street ahead."""
    pose, car = torch.tensor([20.0, 2.0, 0.0]), torch.tensor([[32.0, 1.0, 0.5, 0.0]])
    empty, image = DashCamera(square).draw(pose)[0], DashCamera(square).draw(pose, car)[0]
    hidden = np.zeros((88, 200), bool)
    for row, column in np.ndindex(44, 200):
        ray = np.array([1.0, (column + 0.5 - 100) / FOCAL, -(row + 0.5) / FOCAL])
        start = np.array([20 + FORWARD - 32, 2.0 - 1.0, ABOVE])
        turn = np.array([[math.cos(0.5), math.sin(0.5), 0], [-math.sin(0.5), math.cos(0.5), 0], [0, 0, 1]])
        start, ray = turn @ start, turn @ ray
        low, high = np.array([-2.5, -1.0, 0.0]), np.array([2.5, 1.0, 1.5])
        ends = np.sort(np.stack(((low - start) / ray, (high - start) / ray)), 0)
        hidden[44 + row, column] = ends[0].max() < ends[1].min() + 1e-9
    assert hidden.sum() > 200
    expected = torch.where(torch.from_numpy(hidden), 0, empty)
    assert (image != expected).sum() <= 3  # on the very edge of the box
    rgb = DashCamera(square, modality="rgb")
    changed = (rgb.draw(pose) != rgb.draw(pose, car)).any(0)
    assert changed[~torch.from_numpy(hidden)].sum() <= 3
    assert changed[torch.from_numpy(hidden)].float().mean() > 0.9


def test_walls_reach_as_high_as_they_are(town1):
    """The first wall of each column, found by small steps, ends at the row that its height and distance say."""
    camera = DashCamera(town1, modality="rgb")
    scenery, close = town1.scenery, 0
    poses = poses_of(town1, 4, seed=3)
    mount = Mount.on(poses)
    _, first = camera.sight.ground(scenery, mount)
    facades = painting._facades(camera.sight, scenery, mount, first, camera.sun)
    for n, column in ((n, column) for n in range(4) for column in range(0, 200, 9)):
        right, depth, cell = float(camera.sight.slope[column]), 1.5, None
        while depth < 60:
            along = torch.stack((mount.cos[n] - right * mount.sin[n], mount.sin[n] + right * mount.cos[n]), -1)
            cell = ((mount.xy[n] + depth * along[0] - scenery.corner) / CELL).long().tolist()
            if scenery.walls[0, 0, cell[1], cell[0]] > 0:
                break
            depth *= 1.005
        if depth < 60:
            rows = (float(scenery.walls[0, 1, cell[1], cell[0]]) - ABOVE) / depth * FOCAL
            close += abs(min(rows, 44) - int(facades.rows[n, column])) < 1.5 + 0.03 * rows
            assert facades.depth[n, column] == pytest.approx(depth, abs=0.6 + 0.06 * depth)
    assert close > 70


def test_appearances(town1, town2):
    pose = torch.tensor([[200.0, 2.0, 3.14]])

    def draw(town, appearance):
        return DashCamera(town, modality="rgb", appearance=appearance).draw(pose).float()

    assert torch.equal(draw(town1, 5), draw(town1, 5))
    assert not torch.equal(draw(town1, 5), draw(town1, 5 + 6))  # the same weather, other materials
    weathers = {weather: draw(town1, weather) for weather in WEATHERS}
    assert weathers["night"].mean() < 0.4 * weathers["clear"].mean()
    far = {weather: image[0, :, 35:50, 90:110].std() for weather, image in weathers.items()}
    assert far["fog"] < 0.7 * far["clear"]
    one, other = (
        DashCamera(town, modality="rgb").draw(poses_of(town, 40)).float().mean((0, 2, 3)) for town in (town1, town2)
    )
    assert (one - other).abs().max() > 3


def test_appearance_of_an_episode(town2):
    env = TransformedEnv(TownEnv(town2, 3, seed=0), DashCamera(town2, modality="rgb", appearance="episode"))
    check_env_specs(env)
    td = env.reset()
    numbers = td[keys.APPEARANCE]
    assert len(numbers.unique()) == 3
    rollout = env.rollout(3, auto_reset=False, tensordict=td.clone())
    assert (rollout[keys.APPEARANCE] == numbers.unsqueeze(1)).all()
    assert torch.equal(
        DashCamera(town2, modality="rgb").draw(rollout[keys.POSE], None, rollout[keys.APPEARANCE]), rollout[keys.IMAGE]
    )
    again = env.reset(td.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert (again[keys.APPEARANCE] == numbers).flatten().tolist() == [True, False, True]


def test_appearance_of_a_sample(town2):
    camera = DashCamera(town2, modality="rgb", appearance="sample", seed=1)
    poses = poses_of(town2, 1).expand(4, 3)
    images = camera.draw(poses)
    assert len({image.numpy().tobytes() for image in images}) == 4
    assert not torch.equal(images, camera.draw(poses))
    assert torch.equal(images, DashCamera(town2, modality="rgb", appearance="sample", seed=1).draw(poses))


def test_appearance_in_a_replay_buffer(town2):
    """What the camera was made with counts; only one that draws per episode reads what was stored."""
    poses = poses_of(town2, 6)
    data = TensorDict({keys.POSE: poses, keys.APPEARANCE: torch.arange(6).unsqueeze(-1) * 100}, [6])

    def seen(appearance, data=data):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=6)
        buffer.append_transform(DashCamera(town2, modality="rgb", appearance=appearance))
        buffer.extend(data)
        return [buffer[:][keys.IMAGE] for _ in range(2)]

    camera = DashCamera(town2, modality="rgb")
    assert torch.equal(seen("episode")[0], camera.draw(poses, None, data[keys.APPEARANCE]))
    assert torch.equal(seen("night")[0], DashCamera(town2, modality="rgb", appearance="night").draw(poses))
    assert not torch.equal(*seen("sample"))
    with pytest.raises(ValueError, match="needs the env's reset or"):
        seen("episode", data.select(keys.POSE))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"modality": "depth"}, "modality 'depth' is unknown; use one of gs, rgb"),
        ({"modality": "rgb", "appearance": "snow"}, "'snow' is unknown; use one of clear, overcast"),
        ({"modality": "rgb", "appearance": -1}, "appearance is -1; use a number from 0"),
        ({"modality": "rgb", "appearance": True}, "appearance is True"),
        ({"modality": "rgb", "appearance": 1 << 60}, "use a number from 0 to 2"),
    ],
)
def test_bad_arguments(town1, arguments, message):
    with pytest.raises(ValueError, match=message):
        DashCamera(town1, **arguments)
