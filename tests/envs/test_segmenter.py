"""The segmenter against the network it is made of, with random and with the shipped weights."""

import json
import socket
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import interpolate
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from transformers import MobileNetV2Config, MobileNetV2ForImageClassification, MobileNetV2ForSemanticSegmentation

from ldrl import keys
from ldrl.envs import DashCamera, RoadSegmenter, TownEnv, make_camera, make_env, make_highway_env, segmenter
from ldrl.envs.appearance import WEATHERS
from ldrl.envs.camera import shift
from ldrl.envs.image_format import PREPROCESSING, ImageFormat

HUB = {  # as the DeepLabv3+ weights on the Hub have it, but smaller
    "crop_size": {"height": 60, "width": 60},
    "do_center_crop": True,
    "do_normalize": True,
    "do_rescale": True,
    "do_resize": True,
    "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.5, 0.5, 0.5],
    "image_processor_type": "MobileNetV2ImageProcessor",
    "rescale_factor": 1 / 255,
    "size": {"shortest_edge": 60},
}


def poses(town, count):
    pick = torch.linspace(0, len(town.points) - 1, count).long()
    pose = torch.cat((town.points[pick], town.headings[pick].unsqueeze(-1)), -1)
    return shift(pose, lateral=torch.linspace(-0.6, 0.6, count), yaw=torch.linspace(0.1, -0.1, count))


def save(folder, labels, preprocessing=HUB, pixels=None, **settings):
    """A small network with random weights that has seen ``pixels`` and finds as much of each class in them."""
    torch.manual_seed(0)
    settings = {"depth_multiplier": 0.1, "output_stride": 16, "tf_padding": True} | settings
    network = MobileNetV2ForSemanticSegmentation(MobileNetV2Config(id2label=dict(enumerate(labels)), **settings))
    if pixels is not None:
        with torch.no_grad():
            network.train()(pixels)  # for the statistics, without which the values explode
            network.eval().segmentation_head.classifier.convolution.bias -= network(pixels).logits.mean((0, 2, 3))
    network.save_pretrained(folder)
    (folder / PREPROCESSING).write_text(json.dumps(preprocessing))
    return network


@pytest.fixture(scope="module")
def noise():
    """Images of blots."""
    blots = torch.rand(5, 3, 6, 13, generator=torch.Generator().manual_seed(0))
    return (interpolate(blots, (88, 200), mode="bicubic").clamp(0, 1) * 255).to(torch.uint8)


def agreement(a, b):
    return float((a == b).float().mean())


def test_two_classes_by_the_largest_logit(tmp_path, noise):
    pixels = interpolate(noise.float() / 255, (60, 136), mode="bilinear", antialias=True) * 2 - 1
    network = save(tmp_path, ["background", "road"], pixels=pixels)
    with torch.no_grad():
        logits = interpolate(network(pixels).logits, (88, 200), mode="bilinear")
    expected = logits.argmax(1, keepdim=True) * 255
    found = RoadSegmenter(tmp_path).segment(noise)
    assert found.dtype == torch.uint8
    assert found.unique().tolist() == [0, 255]
    assert 0.1 < (expected > 0).float().mean() < 0.9
    assert agreement(found, expected) > 0.99  # pixels were rounded


@pytest.mark.parametrize("tf_padding", [True, False])
def test_many_classes_below_the_horizon(tmp_path, noise, tf_padding):
    form = ImageFormat(first_row=44, mean=(0.4, 0.5, 0.6), std=(0.2, 0.3, 0.4))
    pixels = (noise[:, :, 44:] / 255 - torch.tensor(form.mean).view(3, 1, 1)) / torch.tensor(form.std).view(3, 1, 1)
    labels = ["sky", "car", "road", "tree"]
    network = save(tmp_path, labels, pixels=pixels, tf_padding=tf_padding, output_stride=8)
    form.write(tmp_path / PREPROCESSING)
    with torch.no_grad():
        logits = network(pixels).logits
    margin = logits[:, 2] - logits[:, [0, 1, 3]].amax(1)
    expected = interpolate(margin.unsqueeze(1), (44, 200), mode="bilinear") > 0
    found = RoadSegmenter(tmp_path, road=2).segment(noise)
    assert not found[:, :, :44].any()
    assert 0.05 < expected.float().mean() < 0.95
    assert agreement(found[:, :, 44:] > 0, expected) > 0.9999
    assert torch.equal(found, RoadSegmenter(tmp_path).segment(noise))
    assert not torch.equal(found, RoadSegmenter(tmp_path, road="sky").segment(noise))


@pytest.mark.parametrize(
    "form",
    [
        ImageFormat(),
        ImageFormat(size=(44, 100), first_row=44),
        ImageFormat(shortest=60, mean=(0.1, 0.2, 0.3), std=(0.4, 0.5, 0.6)),
    ],
)
def test_the_form_of_images_comes_back_from_its_file(tmp_path, noise, form):
    form.write(tmp_path / PREPROCESSING)
    assert ImageFormat.read(tmp_path / PREPROCESSING) == form
    rows = form.size or ((60, 136) if form.shortest else (88, 200))
    assert form.pixels(noise).shape == (5, 3, *rows)


@pytest.mark.parametrize(
    ("told", "form"),
    [
        (HUB, ImageFormat(shortest=60)),
        (HUB | {"do_resize": False}, ImageFormat()),
        (HUB | {"size": 32, "do_normalize": False}, ImageFormat(shortest=32, mean=(0.0,) * 3, std=(1.0,) * 3)),
        (HUB | {"size": {"height": 30, "width": 50}}, ImageFormat(size=(30, 50))),
    ],
)
def test_forms_that_transformers_writes(tmp_path, told, form):
    (tmp_path / PREPROCESSING).write_text(json.dumps(told))
    assert ImageFormat.read(tmp_path / PREPROCESSING) == form


def test_unknown_classes_and_weights(tmp_path):
    folder = tmp_path / "weights"
    save(folder, ["sky", "car"])
    with pytest.raises(ValueError, match=r"no class 'road'.*0 'sky', 1 'car'"):
        RoadSegmenter(folder)
    with pytest.raises(ValueError, match="no class 2"):
        RoadSegmenter(folder, road=2)
    save(folder, ["railroad", "road, route", "car"])
    assert RoadSegmenter(folder).road == 1
    (folder / PREPROCESSING).unlink()
    with pytest.raises(ValueError, match=rf"no segmenter.*{PREPROCESSING}.*road-segmenter"):
        RoadSegmenter(folder, road="car")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no segmenter"):
        RoadSegmenter(tmp_path / "empty")
    MobileNetV2ForImageClassification(MobileNetV2Config(depth_multiplier=0.1)).save_pretrained(tmp_path / "classes")
    (tmp_path / "classes" / PREPROCESSING).write_text(json.dumps(HUB))
    with pytest.raises(ValueError, match=r"no MobileNetV2ForSemanticSegmentation.*segmentation_head"):
        RoadSegmenter(tmp_path / "classes")


def test_without_transformers(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ImportError, match=r"pip install transformers"):
        RoadSegmenter()


def test_importing_ldrl_does_not_import_transformers():
    code = "import sys, ldrl.collectors; assert 'transformers' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


@pytest.fixture(scope="module")
def shipped():
    return RoadSegmenter()


@pytest.mark.parametrize("name", ["town1", "town2"])
def test_shipped_weights_find_the_road_in_towns_they_never_saw(towns, shipped, name):
    pose = poses(towns[name], 8)
    road = DashCamera(towns[name]).draw(pose) > 0
    for weather in (*WEATHERS, "sample"):
        found = shipped.segment(DashCamera(towns[name], modality="rgb", appearance=weather).draw(pose)) > 0
        assert (found & road).sum() / (found | road).sum() > 0.95
        assert not found[:, :, :44].any()


def test_shipped_weights_see_cars(town2, shipped):
    pose = poses(town2, 8)
    cars = torch.cat((shift(pose, 0.5, 0.3), torch.zeros(8, 1)), -1).unsqueeze(1)
    cars[:, 0, :2] += 9 * torch.stack((pose[:, 2].cos(), pose[:, 2].sin()), -1)
    free, taken = DashCamera(town2).draw(pose) > 0, DashCamera(town2).draw(pose, cars) > 0
    found = shipped.segment(DashCamera(town2, modality="rgb").draw(pose, cars)) > 0
    hidden = free & ~taken
    assert hidden.flatten(1).sum(1).min() > 500
    assert found[hidden].float().mean() < 0.15


def test_a_row_alone_any_batch_shape_and_no_network(monkeypatch, towns, noise):
    monkeypatch.setattr(socket.socket, "connect", lambda *_: pytest.fail("went to the network"))
    shipped = RoadSegmenter()
    images = torch.cat((DashCamera(towns["town2"], modality="rgb").draw(poses(towns["town2"], 66)), noise))
    found = shipped.segment(images)
    for row in (0, 40, 65, 70):
        alone = shipped.segment(images[row])
        assert alone.shape == (1, 88, 200)
        assert (alone != found[row]).sum() <= 2  # other sums where the logits are equal
    assert shipped.segment(images[:6].view(2, 3, 3, 88, 200)).shape == (2, 3, 1, 88, 200)
    assert shipped.segment(images[:0]).shape == (0, 1, 88, 200)
    before = images.clone()
    shipped.train()
    assert torch.equal(shipped.segment(images), found)
    assert torch.equal(images, before)


@pytest.mark.parametrize("images", [torch.zeros(2, 1, 88, 200, dtype=torch.uint8), torch.zeros(2, 3, 88, 200)])
def test_needs_rgb(shipped, images):
    with pytest.raises(ValueError, match="modality='rgb'"):
        shipped.segment(images)


def test_in_an_env(town2, episodes):
    check_env_specs(make_env(town2, 2, modality="ps", traffic=2))
    env = make_env(town2, episodes=episodes["town2"][:3], modality="ps", appearance="night")
    assert env.observation_spec[keys.IMAGE].shape == (3, 1, 88, 200)
    rgb = make_env(town2, episodes=episodes["town2"][:3], modality="rgb", appearance="night").reset()[keys.IMAGE]
    assert torch.equal(env.reset()[keys.IMAGE], RoadSegmenter().segment(rgb))
    rows = torch.tensor([[True], [False], [True]])
    again = env.reset(TensorDict({"_reset": rows}, [3]))  # some rows only
    assert again[keys.IMAGE].shape == (3, 1, 88, 200)


def test_only_cars_that_move_see(town2, episodes):
    env = make_env(town2, episodes=episodes["town2"][:3], modality="ps")
    td = env.rand_action(env.reset())
    moves = torch.tensor([True, False, True])
    found = env.step(td.set("_step", moves))["next", *keys.IMAGE]
    poses = td["next", *keys.POSE]
    expected = RoadSegmenter().segment(DashCamera(town2, modality="rgb").draw(poses))
    assert torch.equal(found[moves], expected[moves])
    assert not found[~moves].any()


def test_on_highway_env(episodes):
    env = make_highway_env("town2", episode=episodes["town2"][0], modality="ps")
    check_env_specs(env)
    assert env.reset()[keys.IMAGE].shape == (1, 88, 200)


def test_in_a_replay_buffer(town2):
    transform = make_camera(town2, "ps", appearance="sample")
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=4, transform=transform)
    buffer.extend(TensorDict({keys.POSE: poses(town2, 8)}, [8]))
    sample = buffer.sample()
    road = DashCamera(town2).draw(sample[keys.POSE])
    assert sample[keys.IMAGE].shape == road.shape
    assert agreement(sample[keys.IMAGE], road) > 0.95


def test_appearance_of_the_episode_stays(town2):
    camera = Compose(DashCamera(town2, modality="rgb", appearance="episode"), RoadSegmenter())
    env = TransformedEnv(TownEnv(town2, 2, seed=0), camera)
    check_env_specs(env)
    assert env.reset()[keys.APPEARANCE].shape == (2, 1)


def test_chunks_are_only_for_speed(monkeypatch, shipped, noise):
    together = shipped.segment(noise)
    monkeypatch.setitem(segmenter.FRAMES_AT_ONCE, "cpu", 2)
    assert agreement(shipped.segment(noise), together) > 0.9999
