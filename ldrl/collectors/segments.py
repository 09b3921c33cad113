"""Segments: stretches of a drive that realise a keyword, and the decisions in them to train the high-level policy."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import Storage

from ldrl import keys
from ldrl.collectors.demonstrations import TRAJECTORY
from ldrl.collectors.snippets import DemonstrationSampler, Snippets, cut_snippets
from ldrl.language import KEYWORDS, SAFE_KEYWORDS, Keyword, Passenger, realised_by
from ldrl.modules.high_level import NO_SUBTASK
from ldrl.subtasks import SubTask
from ldrl.towns import Town

__all__ = ["BoundarySampler", "Segment", "find_misleading", "find_segments"]

START = (-70, 16)
"""Frames around the begin of the first manoeuvre in which most instructions are given: from 39 m before it to 3 m into
its junction."""
ANYWHERE = 0.25
"""Share of instructions given anywhere on the way to the first manoeuvre."""
BOUNDARY = (-4, 8)
"""Frames around a boundary in which a decision may fall: a sub-task is voted to have ended a little early or late."""
STOP_IN_SIGHT = 18
"""An instruction given at most so many frames before the first manoeuvre, 16 m before its junction, that asks for an
impossible straight is answered by stopping at once: if the car waits for the manoeuvre it can only stop behind it."""
NONSENSE = 0.03
"""Share of instructions that ask for nothing or that nobody understands: the safe answer is to stop."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a drive that realises a keyword.

    Args:
        snippets: indices of its snippets: the way to the first manoeuvre first, the one behind the last one last. Where
            the right answer is to stop, the last one is the manoeuvre that was driven instead.
        manoeuvres: the right answer at each junction.
    """

    snippets: tuple[int, ...]
    manoeuvres: tuple[SubTask, ...]


def find_segments(
    town: Town,
    snippets: Snippets,
    lane: Tensor,
    max_junctions: int = 3,
    keywords: Mapping[str, Keyword] = KEYWORDS,
) -> dict[str, list[Segment]]:
    """Find every segment of drives that realises a keyword.

    Args:
        town: where the drives are.
        snippets: of the drives.
        lane: the current lane of each frame, ``[N]`` integer.
        max_junctions: the longest segments cross so many junctions: 1 or 2 in the paper, where ordinals of 3 are rare.
        keywords: what to look for.

    Returns:
        Segments by keyword.
    """
    found: dict[str, list[Segment]] = {name: [] for name in keywords}
    subtasks, drives = snippets.subtask.tolist(), snippets.drive_start.tolist()
    offered: list[frozenset[SubTask] | None] = []
    for subtask, start, end in zip(subtasks, snippets.start.tolist(), snippets.end.tolist(), strict=True):
        in_junction = [k for k in lane[start:end].unique().tolist() if int(town.lane_manoeuvre[k]) == subtask]
        offered.append(town.lane_options[in_junction[0]] if subtask != SubTask.LANEFOLLOW and in_junction else None)
    for first in range(len(subtasks)):
        if subtasks[first] != SubTask.LANEFOLLOW:
            continue
        manoeuvres: list[SubTask] = []
        options: list[frozenset[SubTask]] = []
        for last in range(first + 1, len(subtasks)):
            if drives[last] != drives[first] or len(manoeuvres) > max_junctions:
                break
            answer = tuple(manoeuvres)
            if subtasks[last] != SubTask.LANEFOLLOW:
                offer = offered[last]
                if offer is None:
                    break
                answer = (*answer, SubTask.FINISH)  # whatever the car did there, it might have stopped
                manoeuvres.append(SubTask(subtasks[last]))
                options.append(offer)
            if answer and len(answer) <= max_junctions:
                for keyword in realised_by(answer, options, keywords.values()):
                    found[keyword.name].append(Segment(tuple(range(first, last + 1)), answer))
    return found


def find_misleading(
    town: Town, snippets: Snippets, lane: Tensor, max_junctions: int = 3
) -> dict[str, list[list[Segment]]]:
    """Find every segment of drives that is the safe answer to a keyword which the map does not allow there.

    Args:
        town: where the drives are.
        snippets: of the drives.
        lane: the current lane of each frame, ``[N]`` integer.
        max_junctions: the longest segments cross so many junctions.

    Returns:
        Segments by single or double, and by what of it is impossible: each group has another safe answer.
    """
    allowed = find_segments(town, snippets, lane, max_junctions)
    found: dict[str, list[list[Segment]]] = {}
    for name, segments in find_segments(town, snippets, lane, max_junctions, SAFE_KEYWORDS).items():
        possible = set(allowed[name])
        found[name] = _by_answer(segment for segment in segments if segment not in possible)
    return found


def _by_answer(segments: Iterable[Segment]) -> list[list[Segment]]:
    """Group segments by what is done at their junctions."""
    groups: dict[tuple[SubTask, ...], list[Segment]] = {}
    for segment in segments:
        groups.setdefault(segment.manoeuvres, []).append(segment)
    return list(groups.values())


class BoundarySampler(DemonstrationSampler):
    """Draws sequences of high-level decisions at the boundaries between sub-tasks, as many of each keyword.

    A keyword is answered in more than one way where it may pass junctions first; one way is drawn with the square root
    of how often it is driven, since hardly one car in a hundred meets a street on the left only at the third junction.

    The first decision is where the instruction is given; each later one falls around the end of the sub-task before;
    the last one is ``FINISH``. The batch size of the buffer counts decisions, padding included. Each gets the
    instruction's tokens, ``("agent", "previous_subtask")``, the right ``subtask`` and ``mask``, False for padding.

    Args:
        buffer: demonstrations.
        town: where they were driven.
        max_junctions: see :func:`find_segments`.
        misleading: share of the instructions that ask for what the map does not allow, singles and doubles; answered
            safely, see :data:`~ldrl.language.SAFE_KEYWORDS`.
        seed: of the sampler's own generator.

    Raises:
        ValueError: no segment realises a keyword, or misleads one when that is asked for.
    """

    def __init__(
        self,
        buffer: TensorDictReplayBuffer,
        town: Town,
        *,
        max_junctions: int = 3,
        misleading: float = 0.0,
        seed: int = 0,
    ) -> None:
        stored = buffer.storage[:]
        self._snippets = cut_snippets(torch.as_tensor(stored[keys.SUBTASK]), torch.as_tensor(stored[TRAJECTORY]))
        lane = stored[keys.ROUTE][:, 1].long()
        found = find_segments(town, self._snippets, lane, max_junctions)
        lacking = [name for name, segments in found.items() if not segments]
        if lacking:
            where = f"{len(stored)} frames of {town.name}"
            raise ValueError(f"no drive in {where} realises {', '.join(lacking)}; collect more, if its map allows them")
        self._segments = {name: _by_answer(segments) for name, segments in found.items()}
        self._misleading = find_misleading(town, self._snippets, lane, max_junctions) if misleading else {}
        lacking = [name for name, groups in self._misleading.items() if not groups]
        if lacking:
            where = f"{len(stored)} frames of {town.name}"
            raise ValueError(f"no drive in {where} is misled by {', '.join(lacking)}; collect more, if its map can")
        self.decisions = 2 * max_junctions + 1
        self._passenger = Passenger()
        self.misleading = misleading
        self._random = random.Random(seed)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[Any, Tensor]]:
        """Draw sequences.

        Args:
            storage: unused, the segments are known.
            batch_size: decisions, a multiple of ``decisions``.

        Returns:
            Indices ``[batch_size]``, sequence by sequence, and what is written into the sample.
        """
        if batch_size % self.decisions:
            raise ValueError(f"a batch of {batch_size} does not divide into sequences of {self.decisions} decisions")
        frames, targets, previous, sentences = [], [], [], []
        for _ in range(batch_size // self.decisions):
            keyword, segment = self._segment()
            sequence = self._decisions(segment)
            sentence = self._passenger.say(keyword, self._random)
            if self._random.random() < NONSENSE:
                sequence = [(sequence[0][0], SubTask.FINISH)]
                sentence = self._passenger.nonsense(self._random)
            padding = self.decisions - len(sequence)
            frames.append([frame for frame, _ in sequence] + [sequence[-1][0]] * padding)
            chosen = [int(target) for _, target in sequence]
            targets.append(chosen + [int(SubTask.FINISH)] * padding)
            previous.append([NO_SUBTASK, *chosen[:-1]] + [NO_SUBTASK] * padding)
            sentences.append((sentence, len(sequence)))
        tokens = self._passenger.tokenizer([sentence for sentence, _ in sentences])
        length = torch.tensor([n for _, n in sentences])
        info = {
            keys.SUBTASK: torch.tensor(targets).flatten(),
            keys.PREVIOUS_SUBTASK: torch.tensor(previous).flatten(),
            keys.INSTRUCTION_TOKENS: tokens.repeat_interleave(self.decisions, 0),
            "mask": (torch.arange(self.decisions) < length.unsqueeze(-1)).flatten(),
        }
        return torch.tensor(frames).flatten(), info

    def _segment(self) -> tuple[Keyword, Segment]:
        """A keyword and a drive that answers it."""
        # Without misleading instructions nothing is drawn for them: such trainings stay what they were.
        if self._misleading and self._random.random() < self.misleading:
            keyword = self._random.choice(list(SAFE_KEYWORDS.values()))
            return keyword, self._random.choice(self._random.choice(self._misleading[keyword.name]))
        return self._possible()

    def _possible(self) -> tuple[Keyword, Segment]:
        """A keyword and a drive that does what it asks for."""
        keyword = self._random.choice(list(KEYWORDS.values()))
        groups = self._segments[keyword.name]
        (group,) = self._random.choices(groups, [math.sqrt(len(group)) for group in groups])
        return keyword, self._random.choice(group)

    def _decisions(self, segment: Segment) -> list[tuple[int, SubTask]]:
        """Frames and right answers of one drive through a segment."""
        first, manoeuvre = segment.snippets[:2]
        begin, boundary = int(self._snippets.start[first]), int(self._snippets.start[manoeuvre])
        earliest = begin if self._random.random() < ANYWHERE else max(begin, boundary + START[0])
        # A manoeuvre before which the car should stop may be cut off by its drive's end.
        frame = min(self._random.randint(earliest, boundary + START[1]), int(self._snippets.drive_end[manoeuvre]) - 1)
        begun = boundary - STOP_IN_SIGHT if segment.manoeuvres[0] == SubTask.FINISH else boundary
        snippets = list(segment.snippets) if frame < begun else list(segment.snippets[1:])
        decisions = [(frame, SubTask(int(self._snippets.subtask[snippets[0]])))]
        for k in snippets[1:]:
            # Never before the decision before, nor behind the drive, however short a snippet is.
            frame = max(frame, int(self._snippets.start[k]) + self._random.randint(*BOUNDARY))
            frame = min(frame, int(self._snippets.drive_end[k]) - 1)
            decisions.append((frame, SubTask(int(self._snippets.subtask[k]))))
        decisions[-1] = (decisions[-1][0], SubTask.FINISH)
        return decisions

    def state_dict(self) -> dict[str, Any]:
        """The generator's state."""
        return {"random": self._random.getstate()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the generator's state."""
        self._random.setstate(state_dict["random"])
