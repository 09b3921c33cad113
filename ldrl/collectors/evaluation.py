"""Evaluation: exactly one drive per episode, and what it was worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, step_mdp
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ldrl import keys
from ldrl.envs import Episode, RoadSegmenter, make_env
from ldrl.envs.town import STANDING_SPEED
from ldrl.subtasks import SubTask
from ldrl.towns import Town

__all__ = ["Outcome", "evaluate"]

NEAR = 10.0
"""A drive succeeds that passes every point of the path, and its last, this close (paper's evaluation), m."""
FINISH_NEAR = 15.0
"""Strictly, ``finish`` must be declared this close to the path's last point, m."""
RECORDED = (keys.POSE, keys.SPEED, keys.COLLISION, keys.OFF_ROAD, keys.WRONG_LANE)


@dataclass(frozen=True)
class Outcome:
    """How an episode went.

    Args:
        episode: what was to be done.
        success: the paper's measure: no collision, and every point of the path within 10 m of the track; where the car
            should stop, it must also stand at the end, within 10 m of the path's last point.
        strict_success: success, never off the road or in an oncoming lane, and ``finish`` declared within 15 m of the
            path's end.
        collision: whether the car hit a building or another car.
        off_road: whether a corner of the car left the road.
        wrong_lane: whether the car was in an oncoming lane outside junctions.
        finished: whether the agent declared ``finish``.
        stuck: whether the car came to a stand though the agent had not finished.
        finish_distance: from the path's end where ``finish`` was declared, m; None where it was not.
        largest_gap: the largest distance from a point of the path to the track, m.
        seconds: how long it drove.
        track: ``[T, 2]`` float32, x and y, m.
        subtasks: ``[T]`` int64, the agent's sub-task there; ``LANEFOLLOW`` for policies without sub-tasks.
    """

    episode: Episode
    success: bool
    strict_success: bool
    collision: bool
    off_road: bool
    wrong_lane: bool
    finished: bool
    stuck: bool
    finish_distance: float | None
    largest_gap: float
    seconds: float
    track: Tensor
    subtasks: Tensor

    def record(self) -> dict[str, object]:
        """The outcome as JSON values, without the track."""
        episode = {name: getattr(self.episode, name) for name in ("id", "town", "keyword", "instruction")}
        hidden = ("episode", "track", "subtasks")
        return episode | {name: value for name, value in vars(self).items() if name not in hidden}


def evaluate(
    policy: TensorDictModuleBase | Callable[[Town], TensorDictModuleBase],
    episodes: Sequence[Episode],
    towns: dict[str, Town],
    *,
    num_cars: int = 512,
    appearance: str | int = "clear",
    segmenter: str | Path | RoadSegmenter = "road-segmenter",
    device: torch.device | str = "cpu",
    progress: Callable[[int], object] | None = None,
) -> list[Outcome]:
    """Drive each episode once.

    Args:
        policy: the agent, which sees its ``modality`` (``"gs"`` for a policy without one), or what makes a policy for
            a town, such as :class:`~ldrl.collectors.Expert`.
        episodes: of any towns.
        towns: by name, all that the episodes name.
        num_cars: the most episodes driven side by side, of all towns; a policy is asked for all of them at once.
        appearance: of what is seen in colour, see :class:`~ldrl.envs.DashCamera`. That of ``"episode"`` depends on the
            other episodes of the town.
        segmenter: what ``"ps"`` sees with: weights, or a :class:`~ldrl.envs.RoadSegmenter`.
        device: where to drive; an agent must be there, too.
        progress: called with the number of episodes done, some at a time.

    Returns:
        One outcome per episode, in the same order.

    Raises:
        ValueError: an episode of an unknown town, or one whose start or path is off the road; no cars.
    """
    if num_cars < 1:
        raise ValueError(f"num_cars is {num_cars}; give at least 1")
    unknown = {episode.town for episode in episodes} - set(towns)
    if unknown:
        raise ValueError(f"unknown town {min(unknown)!r}; use one of {', '.join(towns)}")
    there = {name: town.on(device) for name, town in towns.items()}
    names = [episode.town for episode in episodes]
    order = sorted(range(len(episodes)), key=lambda i: list(towns).index(names[i]))
    if isinstance(policy, TensorDictModuleBase):
        groups = [(policy, order)]
    else:  # town by town
        groups = [(policy(there[name]), list(rows)) for name, rows in groupby(order, names.__getitem__)]
    make = partial(make_env, appearance=appearance, segmenter=segmenter, device=device)
    outcomes: dict[int, Outcome] = {}
    for actor, group in groups:
        for first in range(0, len(group), num_cars):
            drives = []
            for name, rows in groupby(group[first : first + num_cars], names.__getitem__):
                own = list(rows)
                env = make(there[name], episodes=[episodes[i] for i in own], policy=actor, seed=own[0])
                drives.append(_Drives(env, own))
            _drive(drives, actor, progress)
            for each in drives:
                outcomes |= {i: _judge(episodes[i], drive) for i, drive in zip(each.rows, each.driven(), strict=True)}
    return [outcomes[i] for i in range(len(episodes))]


class _Drives:
    """Drives under way in one env, one in each row."""

    def __init__(self, env: EnvBase, rows: list[int]) -> None:
        self.env, self.rows = env, rows
        self.tensordict = env.reset()
        self.running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
        self.frames = [self.tensordict.select(*RECORDED)]
        self.lengths = torch.ones(env.batch_size, dtype=torch.long, device=env.device)

    def step(self, chosen: TensorDictBase) -> None:
        """Do what was chosen in the rows that still drive; the others stay where they are, whatever it is."""
        running = self.running
        self.tensordict.update(chosen[(running.cumsum(0) - 1).clamp(min=0)])
        tensordict = self.env.step(self.tensordict.set("_step", running))
        # What was chosen belongs to the frame that it was chosen at.
        self.frames[-1].update(tensordict.select(keys.AGENT_SUBTASK, keys.AGENT_FINISH, strict=False))
        self.frames.append(tensordict["next"].select(*RECORDED))
        self.lengths += running
        self.running = running & ~tensordict["next", "done"].squeeze(-1)
        self.tensordict = step_mdp(tensordict)

    def driven(self) -> list[TensorDictBase]:
        """The frames of each drive, when all have ended."""
        self.frames[-1].update(self.frames[-2].select(keys.AGENT_SUBTASK, keys.AGENT_FINISH, strict=False))
        frames = torch.stack(self.frames, 1).cpu()
        return [frames[row, :length] for row, length in enumerate(self.lengths.tolist())]


@torch.no_grad()
def _drive(drives: list[_Drives], policy: TensorDictModuleBase, progress: Callable[[int], object] | None) -> None:
    """Drive all to their ends, those of all envs side by side."""
    policy.eval()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        counts = [len(each.rows) for each in drives]
        while drives:
            chosen = policy(torch.cat([each.tensordict[each.running] for each in drives])).select(*policy.out_keys)
            for each, own in zip(drives, chosen.split(counts), strict=True):
                each.step(own)
            left = [int(each.running.sum()) for each in drives]
            if progress is not None and left != counts:
                progress(sum(counts) - sum(left))
            drives = [each for each, count in zip(drives, left, strict=True) if count]
            counts = [count for count in left if count]


def _judge(episode: Episode, drive: TensorDictBase) -> Outcome:
    """What a drive was worth."""
    track = drive[keys.POSE][:, :2]
    path = torch.tensor(episode.path)
    gap = torch.cdist(path, track).amin(1)
    # Nothing is driven after the last frame: what is chosen there does not count.
    finish = drive.get(keys.AGENT_FINISH, torch.zeros(len(track), dtype=torch.bool))[:-1].nonzero()
    subtasks = drive.get(keys.AGENT_SUBTASK, torch.full((len(track),), int(SubTask.LANEFOLLOW))).clone()
    subtasks[-1] = subtasks[-2]
    finish_distance = float((track[finish[0, 0]] - path[-1]).norm()) if len(finish) else None
    collision, off_road, wrong_lane = (
        bool(drive[key].any()) for key in (keys.COLLISION, keys.OFF_ROAD, keys.WRONG_LANE)
    )
    stands = float(drive[keys.SPEED][-1]) < STANDING_SPEED
    stopped = stands and float((track[-1] - path[-1]).norm()) <= NEAR
    success = not collision and float(gap.max()) <= NEAR and (stopped or not episode.stop)
    declared = finish_distance is not None and finish_distance <= FINISH_NEAR
    return Outcome(
        episode=episode,
        success=success,
        strict_success=success and not off_road and not wrong_lane and declared,
        collision=collision,
        off_road=off_road,
        wrong_lane=wrong_lane,
        finished=finish_distance is not None,
        stuck=finish_distance is None and stands,
        finish_distance=None if finish_distance is None else round(finish_distance, 2),
        largest_gap=round(float(gap.max()), 2),
        seconds=round((len(track) - 1) / 10, 1),
        track=track,
        subtasks=subtasks,
    )
