"""Snippets: stretches of a drive with one sub-task, and slices of them to train low-level policies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import Sampler, Storage
from torchrl.envs import Transform

from ldrl import keys
from ldrl.collectors.demonstrations import TRAJECTORY
from ldrl.collectors.expert import expert_action
from ldrl.envs.camera import shift
from ldrl.modules.controller import VOTES_NEEDED
from ldrl.subtasks import LOW_LEVEL, MANOEUVRES, SubTask
from ldrl.towns import Town

__all__ = ["MARGINS", "DemonstrationSampler", "DisturbedView", "SnippetSampler", "Snippets", "cut_snippets"]

MARGINS = dict.fromkeys(MANOEUVRES, (5, 25)) | {SubTask.LANEFOLLOW: (10, 15)}
"""Frames before and behind a snippet that its slices may reach into. Some slices of a manoeuvre begin inside it, as
where a car sets out at the mouth of a junction. Lane following must not reach so far back into the junction before it,
nor so far into the one behind it, that the two look alike."""
NEAR_END = 0.5
"""Share of slices that show the end of their snippet: lane following is long, and its end would be rare."""
BEND, BENDS = 0.35, 0.5
"""Turn of the heading over a slice that makes it a bend, rad, and the share of bends among lane following's other
slices: bends are where a car leaves the road, and by chance one slice in ten would show one."""


class Snippets(NamedTuple):
    """Stretches of constant sub-task, in the order of the drives.

    Attributes:
        subtask: ``[S]`` int64.
        start: ``[S]`` int64, the first frame.
        end: ``[S]`` int64, the frame after the last.
        drive_start: ``[S]`` int64, the first frame of the drive that it belongs to.
        drive_end: ``[S]`` int64, the frame after the drive's last.
    """

    subtask: Tensor
    start: Tensor
    end: Tensor
    drive_start: Tensor
    drive_end: Tensor


def cut_snippets(subtask: Tensor, drive: Tensor) -> Snippets:
    """Cut drives wherever the sub-task changes.

    Args:
        subtask: of each frame, ``[N]`` int64.
        drive: which drive each frame belongs to, ``[N]`` int64; the frames of a drive follow one another.

    Examples:
        >>> cut_snippets(torch.tensor([3, 3, 0, 3, 3]), torch.tensor([0, 0, 0, 0, 1])).start.tolist()
        [0, 2, 3, 4]
    """

    def runs(changed: Tensor) -> tuple[Tensor, Tensor]:
        start = torch.cat((torch.zeros(1, dtype=torch.long), changed.nonzero().squeeze(-1) + 1))
        return start, torch.cat((start[1:], torch.tensor([len(subtask)])))

    new_drive = drive[1:] != drive[:-1]
    start, end = runs(new_drive | (subtask[1:] != subtask[:-1]))
    drive_start, drive_end = runs(new_drive)
    which = torch.searchsorted(drive_start, start, right=True) - 1
    return Snippets(subtask[start], start, end, drive_start[which], drive_end[which])


class DemonstrationSampler(Sampler):
    """A sampler that knows its demonstrations by heart, so it serves no other buffer.

    A subclass gives ``sample``, ``state_dict`` and ``load_state_dict``.
    """

    def _empty(self) -> None:
        raise RuntimeError(
            f"a {type(self).__name__} is bound to the demonstrations that it was made from; make a new one"
        )

    def dumps(self, path: Any) -> None:
        """Save the state to a file."""
        torch.save(self.state_dict(), path)

    def loads(self, path: Any) -> None:
        """Load the state from a file."""
        self.load_state_dict(torch.load(path))


class SnippetSampler(DemonstrationSampler):
    """Draws slices of fixed length within snippets and their margins, as many of each sub-task.

    The batch size of the buffer counts frames, as with :class:`torchrl.data.SliceSampler`. Each frame gets the
    snippet's ``subtask``, which its low-level policies are told, and ``end_of_subtask``, whether to vote for its end:
    true in the margin behind it, and in the frames before that the controller takes to count the votes. Half of the
    slices show their snippet's end; of the others of lane following, half lie in a bend, if there is any.

    Args:
        buffer: demonstrations.
        slice_length: frames in a slice.
        margins: frames before and behind a snippet, for each sub-task.
        seed: of the sampler's own generator.

    Raises:
        ValueError: a sub-task has no snippet that is long enough.
    """

    def __init__(
        self,
        buffer: TensorDictReplayBuffer,
        slice_length: int = 40,
        margins: Mapping[SubTask, tuple[int, int]] = MARGINS,
        seed: int = 0,
    ) -> None:
        stored = buffer.storage[:]
        snippets = cut_snippets(torch.as_tensor(stored[keys.SUBTASK]), torch.as_tensor(stored[TRAJECTORY]))
        before, behind = torch.tensor([margins[subtask] for subtask in LOW_LEVEL])[snippets.subtask].unbind(-1)
        first = (snippets.start - before).maximum(snippets.drive_start)
        last = (snippets.end + behind).minimum(snippets.drive_end) - slice_length
        fits = last >= first
        # The first frame to vote in; a snippet that is cut off with its drive has none.
        vote = torch.where(snippets.end < snippets.drive_end, snippets.end - VOTES_NEEDED, snippets.drive_end)
        self.slice_length = slice_length
        self._generator = torch.Generator().manual_seed(seed)
        self._groups = []
        for subtask in LOW_LEVEL:
            rows = (fits & (snippets.subtask == subtask)).nonzero().squeeze(-1)
            if not len(rows):
                raise ValueError(
                    f"no {subtask.name.lower()} snippet of {slice_length} frames in {len(stored)} frames; collect more"
                )
            self._groups.append((int(subtask), first[rows], last[rows], snippets.end[rows], vote[rows]))
        self._bends = self._find_bends(torch.as_tensor(stored[keys.POSE])[:, 2])

    def _find_bends(self, heading: Tensor) -> tuple[Tensor, Tensor]:
        """The starts of all slices of lane following that lie in a bend, and from when on to vote for their end."""
        starts, votes = [], []
        for subtask, *snippets in self._groups:
            for first, last, _, vote in zip(*snippets, strict=True) if subtask == SubTask.LANEFOLLOW else ():
                start = torch.arange(int(first), int(last) + 1)
                turned = heading[start + self.slice_length - 1] - heading[start]
                bends = start[torch.atan2(turned.sin(), turned.cos()).abs() > BEND]
                starts.append(bends)
                votes.append(vote.expand(len(bends)))
        return torch.cat(starts), torch.cat(votes)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[Any, Tensor]]:
        """Draw slices.

        Args:
            storage: unused, the snippets are known.
            batch_size: frames, a multiple of four slices.

        Returns:
            Indices ``[batch_size]``, slice by slice, and what is written into the sample.
        """
        each, rest = divmod(batch_size, len(self._groups) * self.slice_length)
        if rest:
            raise ValueError(
                f"a batch of {batch_size} frames does not divide into slices of {self.slice_length} frames for "
                f"{len(self._groups)} sub-tasks; use a multiple of {len(self._groups) * self.slice_length}"
            )
        steps = torch.arange(self.slice_length)
        index, ended, told = [], [], []
        for subtask, first, last, end, vote in self._groups:
            rows = torch.randint(len(first), (each,), generator=self._generator)
            near_end = torch.rand(each, generator=self._generator) < NEAR_END
            low = torch.where(near_end, (end[rows] - self.slice_length + 1).clamp(first[rows], last[rows]), first[rows])
            part = torch.rand(each, generator=self._generator)
            start, voting = low + (part * (last[rows] - low + 1)).long(), vote[rows]
            if subtask == SubTask.LANEFOLLOW and len(self._bends[0]):
                bend = torch.randint(len(self._bends[0]), (each,), generator=self._generator)
                anew = ~near_end & (torch.rand(each, generator=self._generator) < BENDS)
                start = start.where(~anew, self._bends[0][bend])
                voting = voting.where(~anew, self._bends[1][bend])
            frames = start.unsqueeze(-1) + steps
            index.append(frames)
            ended.append(frames >= voting.unsqueeze(-1))
            told.append(torch.full_like(frames, subtask))
        info = {keys.SUBTASK: torch.cat(told).flatten(), keys.END_OF_SUBTASK: torch.cat(ended).flatten()}
        return torch.cat(index).flatten(), info

    def state_dict(self) -> dict[str, Any]:
        """The generator's state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the generator's state."""
        self._generator.set_state(state_dict["generator"])


class DisturbedView(Transform):
    """Shows each slice as if its car stood beside its line, and relabels the action exactly.

    A shift to the side and a turn are drawn once per slice; the pose is moved, the expert is asked at the moved pose,
    and a :class:`~ldrl.envs.DashCamera` behind this transform draws what is seen from there. So recovery is learned
    with exact labels, instead of the paper's side cameras with a constant correction.

    Args:
        town: where the demonstrations were driven.
        slice_length: frames in a slice.
        lateral: standard deviation of the shift, m.
        yaw: standard deviation of the turn, rad; the paper's side cameras look 14 degrees (0.24) aside.
        seed: of the transform's own generator.
    """

    def __init__(self, town: Town, slice_length: int, *, lateral: float = 0.4, yaw: float = 0.1, seed: int = 0) -> None:
        super().__init__(
            in_keys=[keys.POSE, keys.SPEED, keys.ROUTE, keys.ROUTE_POSITION], out_keys=[keys.POSE, keys.ACTION]
        )
        self.town = town
        self.slice_length = slice_length
        self.lateral = lateral
        self.yaw = yaw
        self._generator = torch.Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Move the poses and write the expert's actions there."""
        slices = -(-tensordict.numel() // self.slice_length)
        pose = tensordict[keys.POSE]
        lateral, yaw = (
            torch.randn(2, slices, generator=self._generator)
            .clamp(-3, 3)
            .to(pose.device)
            .repeat_interleave(self.slice_length, 1)[:, : len(pose)]
        )
        pose = shift(pose, self.lateral * lateral, self.yaw * yaw)
        tensordict[keys.POSE] = pose
        speed, position = tensordict[keys.SPEED].squeeze(-1), tensordict[keys.ROUTE_POSITION].squeeze(-1)
        tensordict[keys.ACTION] = expert_action(self.town, pose, speed, tensordict[keys.ROUTE], position)
        return tensordict
