"""Demonstrations: what is stored, and how the steering is disturbed."""

import pytest
import torch
from tensordict import TensorDict

from ldrl import keys
from ldrl.collectors import SteeringNoise, collect_demonstrations, expert_action, load_demonstrations
from ldrl.collectors.demonstrations import TRAJECTORY
from ldrl.envs.labels import route_subtask


def expert(town, stored):
    speed, position = stored[keys.SPEED].squeeze(-1), stored[keys.ROUTE_POSITION].squeeze(-1)
    return expert_action(town, stored[keys.POSE], speed, stored[keys.ROUTE], position)


def test_68_bytes_a_frame(town2, tmp_path):
    buffer = collect_demonstrations(town2, 400, num_cars=4, path=tmp_path)
    stored = buffer.storage[:]
    size = sum(value.numel() * value.element_size() for value in stored.values(True, True))
    assert size == 68 * len(buffer)
    files = sum(path.stat().st_size for path in tmp_path.rglob("*.memmap"))
    assert files <= 100 * len(buffer)
    assert files >= 32 * len(buffer)  # they are there
    assert keys.IMAGE not in stored.keys(True)


def test_frames_of_a_drive_follow_one_another(demonstrations):
    stored = demonstrations.storage[:]
    assert len(demonstrations) == len(stored) == 32 * 600
    drive = stored[TRAJECTORY].view(32, 600)
    assert (drive == drive[:, :1]).all()
    assert len(drive[:, 0].unique()) == 32
    pose = stored[keys.POSE].view(32, 600, 3)
    moved = (pose[:, 1:, :2] - pose[:, :-1, :2]).norm(dim=-1)
    assert moved.min() > 0.3
    assert moved.max() < 0.7  # 20 km/h at 10 Hz: 0.56 m
    assert (pose[1:, 0, :2] - pose[:-1, -1, :2]).norm(dim=-1).median() > 10
    done = stored["next", "done"].view(32, 600)
    assert done[:, -1].all()
    assert not done[:, :-1].any()


def test_labels_are_the_routes(town2, demonstrations):
    stored = demonstrations.storage[:]
    subtask = route_subtask(town2, stored[keys.ROUTE], stored[keys.ROUTE_POSITION].squeeze(-1))
    assert torch.equal(stored[keys.SUBTASK], subtask)
    by_drive = subtask.view(32, 600)
    ended = stored[keys.END_OF_SUBTASK].view(32, 600)
    assert torch.equal(ended[:, 1:], by_drive[:, 1:] != by_drive[:, :-1])
    assert not ended[:, 0].any()


def test_without_noise_the_expert_drives(town2, tmp_path):
    stored = collect_demonstrations(town2, 240, num_cars=4, noise=0.0, path=tmp_path).storage[:]
    torch.testing.assert_close(stored[keys.ACTION], expert(town2, stored), atol=2e-3, rtol=0)


def test_noise_disturbs_the_steering_only(town2, demonstrations):
    stored = demonstrations.storage[:]
    off = stored[keys.ACTION] - expert(town2, stored)
    assert off[:, 0].abs().max() < 1e-3
    disturbed = off[:, 1].abs() > 0.01
    assert 0.05 < disturbed.float().mean() < 0.7  # bursts, and pauses between them
    assert abs(off[:, 1].mean()) < 0.02


def test_seeds(town2, tmp_path):
    def collect(seed, name):
        return collect_demonstrations(town2, 120, num_cars=4, seed=seed, path=tmp_path / name).storage[:]

    first, again, other = collect(0, "a"), collect(0, "b"), collect(1, "c")
    for key in first.keys(True, True):
        assert torch.equal(first[key], again[key]), key
    for key in (keys.POSE, keys.ACTION, keys.ROUTE):
        assert not torch.equal(first[key], other[key]), key


@pytest.mark.parametrize(("frames", "cars"), [(0, 4), (3, 4), (10, 4), (-4, 4)])
def test_frames_divide_among_cars(town2, frames, cars):
    with pytest.raises(ValueError, match=f"{frames} frames do not divide among {cars} cars; use a positive multiple"):
        collect_demonstrations(town2, frames, num_cars=cars)


def noise_of(noise, steps=600, cars=3, action=(0.25, 0.0)):
    td = TensorDict({keys.ACTION: torch.tensor([action] * cars)}, [cars])
    return torch.stack([noise(td.clone())[keys.ACTION] for _ in range(steps)], 1)


@pytest.mark.usefixtures("global_rng")
def test_noise_is_its_own_for_every_car_and_seed():
    first, again, other = (noise_of(SteeringNoise(seed=seed)) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    steer = first[..., 1]
    assert (first[..., 0] == 0.25).all()
    assert (torch.corrcoef(noise_of(SteeringNoise(), 4000)[..., 1]) - torch.eye(3)).abs().max() < 0.2
    assert (steer != 0).any(1).all()
    assert (steer == 0).float().mean() > 0.3


def test_noise_is_smooth_scaled_and_clipped():
    steer = noise_of(SteeringNoise(0.1, seed=2), 4000)[..., 1]
    step = (steer[:, 1:] - steer[:, :-1]).std()
    assert step < 0.7 * steer.std() * 2**0.5  # white noise would have 1.0
    torch.testing.assert_close(noise_of(SteeringNoise(0.2, seed=2), 4000)[..., 1], 2 * steer)
    assert not noise_of(SteeringNoise(0.0))[..., 1].any()
    assert noise_of(SteeringNoise(5.0))[..., 1].abs().max() == 1
    assert noise_of(SteeringNoise(), action=(0.25, 1.0))[..., 1].max() == 1


def test_demonstrations_are_loaded_as_they_were_collected(town2, tmp_path):
    collected = collect_demonstrations(town2, 120, num_cars=4, path=tmp_path / "town2")
    loaded = load_demonstrations(tmp_path / "town2")
    assert len(loaded) == 120
    assert (loaded.storage[:] == collected.storage[:]).all()
    with pytest.raises(FileNotFoundError, match=r"no demonstrations in .*atlantis"):
        load_demonstrations(tmp_path / "atlantis")
