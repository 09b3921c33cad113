"""Whole drives through segments, and images drawn once."""

import pytest
import torch
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose

from ldrl import keys
from ldrl.collectors import BoundarySampler, DisturbedView, DriveSampler, OncePerFrame
from ldrl.envs import DashCamera
from ldrl.subtasks import SubTask


@pytest.fixture
def sampler(demonstrations, town2):
    return DriveSampler(demonstrations, town2, length=300)


def test_drives_go_on_frame_by_frame_to_behind_the_last_manoeuvre(sampler, demonstrations, labels):
    subtask, drive, _ = labels
    index, info = sampler.sample(demonstrations.storage, 100 * 300)
    index, mask = index.view(100, 300), info["mask"].view(100, 300)
    lengths = mask.sum(1)
    assert lengths.min() > 15
    assert (lengths == 300).any()  # cut
    assert torch.equal(mask, torch.arange(300) < lengths.unsqueeze(-1))
    for frames, n in zip(index, lengths.tolist(), strict=True):
        assert torch.equal(frames[:n], torch.arange(int(frames[0]), int(frames[0]) + n))
        assert (frames[n:] == frames[n - 1]).all()
        assert len(drive[frames].unique()) == 1
        end = int(frames[-1])
        if n < 300 and drive[(end + 1) % len(drive)] == drive[end]:  # neither cut nor at the end of all frames
            assert (subtask[frames[n - 15 : n]] == SubTask.LANEFOLLOW).all()
            assert subtask[frames[n - 16]] != SubTask.LANEFOLLOW
    tokens = info[keys.INSTRUCTION_TOKENS].view(100, 300, -1)
    assert (tokens == tokens[:, :1]).all()
    assert len(tokens[:, 0].unique(dim=0)) > 75


@pytest.mark.usefixtures("global_rng")
def test_the_same_seed_draws_the_same(demonstrations, town2):
    first, again, other = (
        DriveSampler(demonstrations, town2, length=50, seed=seed).sample(demonstrations.storage, 500)[0]
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_batch_must_divide(sampler, demonstrations):
    with pytest.raises(ValueError, match="batch of 301 frames does not divide into drives of 300 frames"):
        sampler.sample(demonstrations.storage, 301)


def test_drawing_once_is_drawing_all(demonstrations, town2):
    def sample(camera):
        sampler = BoundarySampler(demonstrations, town2)
        return TensorDictReplayBuffer(
            storage=demonstrations.storage,
            sampler=sampler,
            batch_size=8 * sampler.decisions,
            transform=Compose(DisturbedView(town2, sampler.decisions), camera),
        ).sample()

    drawn = []
    camera = DashCamera(town2)
    draw = camera.draw
    camera.draw = lambda pose, *rest: drawn.append(len(pose)) or draw(pose, *rest)
    once, every = sample(OncePerFrame(camera)), sample(DashCamera(town2))
    assert torch.equal(once[keys.IMAGE], every[keys.IMAGE])
    assert drawn == [len(every["index"].unique_consecutive())]
    assert drawn[0] < len(every)
