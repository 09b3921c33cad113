"""Snippets, the slices drawn from them, and views from beside the line."""

import math

import pytest
import torch
from torchrl.data import TensorDictReplayBuffer

from ldrl import keys
from ldrl.collectors import DisturbedView, SnippetSampler, cut_snippets, expert_action
from ldrl.envs import DashCamera
from ldrl.envs.camera import shift
from ldrl.subtasks import LOW_LEVEL, MANOEUVRES, SubTask

LENGTH, MARGIN, EACH = 15, 6, 40
MARGINS = dict.fromkeys(LOW_LEVEL, (MARGIN, MARGIN))


@pytest.fixture
def sampled(demonstrations):
    sampler = SnippetSampler(demonstrations, LENGTH, MARGINS)
    index, info = sampler.sample(demonstrations.storage, EACH * 4 * LENGTH)
    return index.view(-1, LENGTH), {key: value.view(-1, LENGTH) for key, value in info.items()}


def test_cut_by_hand():
    subtask = torch.tensor([3, 3, 0, 3, 3, 3, 1, 1, 3])
    drive = torch.tensor([7, 7, 7, 7, 2, 2, 2, 2, 2])
    snippets = cut_snippets(subtask, drive)
    assert snippets.subtask.tolist() == [3, 0, 3, 3, 1, 3]
    assert snippets.start.tolist() == [0, 2, 3, 4, 6, 8]
    assert snippets.end.tolist() == [2, 3, 4, 6, 8, 9]
    assert snippets.drive_start.tolist() == [0, 0, 0, 4, 4, 4]
    assert snippets.drive_end.tolist() == [4, 4, 4, 9, 9, 9]
    assert [len(column) for column in cut_snippets(torch.tensor([3]), torch.tensor([0]))] == [1] * 5


def test_cut_is_the_plain_loop(labels):
    subtask, drive, _ = labels
    snippets = cut_snippets(subtask, drive)
    frames = list(zip(subtask.tolist(), drive.tolist(), strict=True))
    starts = [k for k, frame in enumerate(frames) if k == 0 or frames[k - 1] != frame]
    assert snippets.start.tolist() == starts
    assert snippets.end.tolist() == [*starts[1:], len(frames)]
    assert torch.equal(snippets.subtask, subtask[snippets.start])


def test_slices_lie_in_one_drive_and_near_their_snippet(sampled, labels):
    index, info = sampled
    subtask, drive, _ = labels
    assert torch.equal(index, index[:, :1] + torch.arange(LENGTH))
    assert index.min() >= 0
    assert index.max() < len(drive)
    assert (drive[index] == drive[index[:, :1]]).all()
    told, label = info[keys.SUBTASK], subtask[index]
    assert (told == told[:, :1]).all()
    inside = label == told
    assert inside.any(1).all()
    before = (~inside & ~inside.cumsum(1).bool()).sum(1)
    assert before.max() == MARGIN
    ended = ~inside & inside.cumsum(1).bool()
    assert ended.sum(1).max() == MARGIN
    # Two votes are needed and count from the step after the second on: the first is due two frames before the end.
    soon = torch.zeros_like(ended)
    for ahead in (1, 2):
        frames = (index + ahead).clamp(max=len(drive) - 1)
        soon |= inside & (drive[frames] == drive[index]) & (subtask[frames] != told)
    assert torch.equal(info[keys.END_OF_SUBTASK], ended | soon)
    last_of_drive = drive[(index + 1).clamp(max=len(drive) - 1)] != drive[index]
    assert (last_of_drive & inside).any()


def test_slices_are_balanced_and_show_ends(sampled):
    _, info = sampled
    told = info[keys.SUBTASK][:, 0]
    for subtask in LOW_LEVEL:
        assert (told == subtask).sum() == EACH
        ends = info[keys.END_OF_SUBTASK][told == subtask].any(1).float().mean()
        assert 0.25 < ends < 0.95, subtask


def test_lane_following_lies_in_bends_more_often_than_by_chance(demonstrations, monkeypatch):
    heading = demonstrations.storage[:][keys.POSE][:, 2]

    def bends():
        sampler = SnippetSampler(demonstrations, 40)
        index, info = sampler.sample(demonstrations.storage, 300 * 4 * 40)
        slices = index.view(-1, 40)[info[keys.SUBTASK].view(-1, 40)[:, 0] == SubTask.LANEFOLLOW]
        turned = heading[slices[:, -1]] - heading[slices[:, 0]]
        return float((torch.atan2(turned.sin(), turned.cos()).abs() > 0.35).float().mean())

    often = bends()
    monkeypatch.setattr("ldrl.collectors.snippets.BEND", 9.0)  # none is found
    by_chance = bends()
    assert by_chance < 0.2
    assert 0.2 < often - by_chance < 0.3


def test_each_subtask_has_margins_of_its_own(demonstrations, labels):
    subtask = labels[0]
    margins = {SubTask.LEFT: (2, 9), SubTask.RIGHT: (0, 5), SubTask.STRAIGHT: (4, 0), SubTask.LANEFOLLOW: (7, 3)}
    index, info = SnippetSampler(demonstrations, LENGTH, margins).sample(demonstrations.storage, 300 * 4 * LENGTH)
    index, told = index.view(-1, LENGTH), info[keys.SUBTASK].view(-1, LENGTH)
    inside = subtask[index] == told
    before = (~inside & ~inside.cumsum(1).bool()).sum(1)
    behind = (~inside & inside.cumsum(1).bool()).sum(1)
    for which, reach in margins.items():
        drawn = told[:, 0] == which
        assert (before[drawn].max(), behind[drawn].max()) == reach, which


def test_some_slices_of_a_manoeuvre_begin_inside_it(demonstrations, labels):
    subtask = labels[0]
    index, info = SnippetSampler(demonstrations).sample(demonstrations.storage, 300 * 4 * 40)
    starts, told = index.view(-1, 40)[:, 0], info[keys.SUBTASK].view(-1, 40)[:, 0]
    for which in MANOEUVRES:
        begun = subtask[(starts[told == which] - 4).clamp(min=0)] == which
        assert 0.1 < begun.float().mean() < 0.9, which


def test_every_snippet_that_fits_is_drawn(demonstrations, labels):
    subtask, drive, _ = labels
    snippets = cut_snippets(subtask, drive)
    index, info = SnippetSampler(demonstrations, LENGTH, MARGINS).sample(demonstrations.storage, 600 * 4 * LENGTH)
    left = index.view(-1, LENGTH)[info[keys.SUBTASK].view(-1, LENGTH)[:, 0] == 0]
    lengths = (snippets.end + MARGIN).minimum(snippets.drive_end) - (snippets.start - MARGIN).maximum(
        snippets.drive_start
    )
    for start, end in zip(snippets.start[snippets.subtask == 0], snippets.end[snippets.subtask == 0], strict=True):
        if lengths[snippets.start == start] >= LENGTH:
            assert ((left >= start) & (left < end)).any()


def test_a_buffer_writes_what_the_sampler_says(demonstrations):
    def sample(seed):
        return TensorDictReplayBuffer(
            storage=demonstrations.storage,
            sampler=SnippetSampler(demonstrations, LENGTH, MARGINS, seed=seed),
            batch_size=4 * LENGTH,
        ).sample()

    first, again, other = sample(0), sample(0), sample(1)
    assert first.shape == (4 * LENGTH,)
    assert torch.equal(first[keys.POSE], again[keys.POSE])
    assert not torch.equal(first[keys.POSE], other[keys.POSE])
    index, info = SnippetSampler(demonstrations, LENGTH, MARGINS).sample(demonstrations.storage, 4 * LENGTH)
    assert torch.equal(first[keys.POSE], demonstrations.storage[:][keys.POSE][index])
    for key, value in info.items():
        assert torch.equal(first[key], value)


@pytest.mark.usefixtures("global_rng")
def test_state_goes_on_where_it_was(demonstrations, tmp_path):
    sampler = SnippetSampler(demonstrations, LENGTH, MARGINS)
    sampler.sample(demonstrations.storage, 4 * LENGTH)
    sampler.dumps(tmp_path / "state")
    expected, _ = sampler.sample(demonstrations.storage, 4 * LENGTH)
    fresh = SnippetSampler(demonstrations, LENGTH, MARGINS, seed=5)
    fresh.loads(tmp_path / "state")
    assert torch.equal(fresh.sample(demonstrations.storage, 4 * LENGTH)[0], expected)


def test_errors_say_what_to_do(demonstrations, few):
    sampler = SnippetSampler(demonstrations, LENGTH, MARGINS)
    with pytest.raises(ValueError, match=rf"batch of 100 frames .* slices of {LENGTH} .*multiple of {4 * LENGTH}"):
        sampler.sample(demonstrations.storage, 100)
    with pytest.raises(ValueError, match=rf"no \w+ snippet of {LENGTH} frames in 60 frames; collect more"):
        SnippetSampler(few, LENGTH, MARGINS)


@pytest.fixture
def frames(demonstrations, sampled):
    return demonstrations.storage[sampled[0].flatten()].clone()


def expert(town, td, pose):
    speed, position = td[keys.SPEED].squeeze(-1), td[keys.ROUTE_POSITION].squeeze(-1)
    return expert_action(town, pose, speed, td[keys.ROUTE], position)


def test_without_disturbance_the_pose_stays(town2, frames):
    seen = DisturbedView(town2, LENGTH, lateral=0.0, yaw=0.0)(frames.clone())
    assert torch.equal(seen[keys.POSE], frames[keys.POSE])
    assert torch.equal(seen[keys.ACTION], expert(town2, frames, frames[keys.POSE]))


@pytest.mark.usefixtures("global_rng")
def test_each_slice_is_moved_as_a_whole_and_relabelled(town2, frames):
    seen = DisturbedView(town2, LENGTH, lateral=0.4, yaw=0.1, seed=1)(frames.clone())
    assert torch.equal(seen[keys.ACTION], expert(town2, frames, seen[keys.POSE]))
    assert not torch.allclose(seen[keys.ACTION], frames[keys.ACTION], atol=0.1)
    heading = frames[keys.POSE][:, 2]
    offset = seen[keys.POSE][:, :2] - frames[keys.POSE][:, :2]
    lateral = (offset[:, 1] * heading.cos() - offset[:, 0] * heading.sin()).view(-1, LENGTH)
    forward = offset[:, 0] * heading.cos() + offset[:, 1] * heading.sin()
    yaw = (seen[keys.POSE][:, 2] - heading).view(-1, LENGTH)
    assert forward.abs().max() < 1e-3
    for shifts, scale in ((lateral, 0.4), (yaw, 0.1)):
        torch.testing.assert_close(shifts, shifts[:, :1].expand_as(shifts), atol=1e-3, rtol=0)
        assert scale * 0.75 < shifts[:, 0].std() < scale * 1.25
        assert abs(shifts[:, 0].mean()) < scale * 0.35
    moved = shift(frames[keys.POSE], lateral.flatten(), yaw.flatten())
    torch.testing.assert_close(seen[keys.POSE], moved, atol=1e-3, rtol=0)


def test_a_car_beside_its_line_is_told_to_return(town2, frames):
    told = DisturbedView(town2, LENGTH, lateral=0.5, yaw=0.0, seed=1)(frames.clone())
    side = (told[keys.POSE][:, :2] - frames[keys.POSE][:, :2]).norm(dim=-1)
    right = expert(town2, frames, shift(frames[keys.POSE], 0.5, 0.0))[:, 1]
    left = expert(town2, frames, shift(frames[keys.POSE], -0.5, 0.0))[:, 1]
    free = (right.abs() < 1) & (left.abs() < 1)
    assert free.float().mean() > 0.5
    assert (right < left)[free].all()
    assert side.max() <= 1.5 + 1e-3  # no further than three standard deviations


def test_views_are_seeded_and_leave_the_storage_alone(town2, demonstrations):
    before = demonstrations.storage[:].clone()

    def sample(seed):
        return TensorDictReplayBuffer(
            storage=demonstrations.storage,
            sampler=SnippetSampler(demonstrations, LENGTH, MARGINS),
            batch_size=4 * LENGTH,
            transform=DisturbedView(town2, LENGTH, seed=seed),
        ).sample()

    first, again, other = sample(0), sample(0), sample(1)
    assert torch.equal(first[keys.POSE], again[keys.POSE])
    assert not torch.equal(first[keys.POSE], other[keys.POSE])
    assert (demonstrations.storage[:] == before).all()


def test_the_camera_behind_it_draws_the_moved_view(town2, demonstrations):
    buffer = TensorDictReplayBuffer(
        storage=demonstrations.storage,
        sampler=SnippetSampler(demonstrations, LENGTH, MARGINS),
        batch_size=4 * LENGTH,
        transform=DisturbedView(town2, LENGTH, lateral=0.8, yaw=math.radians(14)),
    )
    camera = DashCamera(town2)
    buffer.append_transform(camera)
    seen = buffer.sample()
    assert torch.equal(seen[keys.IMAGE], camera.draw(seen[keys.POSE]))
