"""Demonstrations: the expert's drives, stored as poses."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer, TensorStorage
from torchrl.envs import TransformedEnv

from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import SubtaskLabels, TownEnv
from ldrl.towns import Town

__all__ = ["TRAJECTORY", "SteeringNoise", "collect_demonstrations", "load_demonstrations"]

TRAJECTORY = ("collector", "traj_ids")
"""Which drive a frame belongs to, ``[N]`` int64."""
STORED = (
    keys.POSE,
    keys.SPEED,
    keys.ROUTE,
    keys.ROUTE_POSITION,
    keys.ACTION,
    keys.SUBTASK,
    keys.END_OF_SUBTASK,
    TRAJECTORY,
    *(("next", flag) for flag in ("done", "terminated", "truncated")),
)


class SteeringNoise(TensorDictModuleBase):
    """Pushes cars off their line: adds smooth noise to the steer, in bursts with pauses in which the car recovers.

    The noise is ``scale`` times a first-order autoregressive process of unit variance, cut to what lies beyond one
    standard deviation. Each car has a process of its own.

    Args:
        scale: of the noise, in units of full steer.
        correlation: of the process from one step to the next.
        seed: of the module's own generator.
    """

    in_keys = [keys.ACTION]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, scale: float = 0.15, correlation: float = 0.9, seed: int = 0) -> None:
        super().__init__()
        self.scale = scale
        self.correlation = correlation
        self._generator = torch.Generator().manual_seed(seed)
        self._process: torch.Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Disturb the action."""
        action = tensordict[keys.ACTION]
        fresh = torch.randn(action.shape[:-1], generator=self._generator).to(action.device)
        if self._process is None or self._process.shape != fresh.shape:
            self._process = fresh
        else:
            self._process = self.correlation * self._process + (1 - self.correlation**2) ** 0.5 * fresh
        burst = self._process - self._process.clamp(-1, 1)
        steer = (action[..., 1] + self.scale * burst).clamp(-1, 1)
        tensordict[keys.ACTION] = torch.stack((action[..., 0], steer), -1)
        return tensordict


def collect_demonstrations(
    town: Town, frames: int, *, num_cars: int = 128, path: str | Path | None = None, noise: float = 0.15, seed: int = 0
) -> TensorDictReplayBuffer:
    """Let the expert roam, with disturbed steering, and store every frame in 68 bytes.

    A frame is the pose, speed and route, the action that was driven and the sub-task's labels; images are drawn from
    poses when sampled. The expert's own action at any state is :func:`~ldrl.collectors.expert_action`.

    Args:
        town: where to drive.
        frames: how many frames, a multiple of ``num_cars``.
        num_cars: cars that drive side by side; each drives ``frames / num_cars`` frames.
        path: folder of the memory-mapped storage, for :func:`load_demonstrations`; another one there is overwritten.
            None for temporary files.
        noise: scale of :class:`SteeringNoise`.
        seed: of cars and noise.

    Returns:
        A buffer of ``frames`` frames, in which the frames of a drive follow one another.

    Raises:
        ValueError: ``frames`` is not a positive multiple of ``num_cars``.

    Examples:
        >>> buffer = collect_demonstrations(Town.load("town1"), 40, num_cars=4)
        >>> len(buffer)
        40
    """
    if frames < num_cars or frames % num_cars:
        raise ValueError(f"{frames} frames do not divide among {num_cars} cars; use a positive multiple")
    steps = frames // num_cars
    drive = TownEnv(town, num_cars, max_steps=steps, seed=seed)
    env = TransformedEnv(drive, SubtaskLabels(drive.town))
    policy = TensorDictSequential(Expert(drive.town), SteeringNoise(noise, seed=seed))
    folder = None if path is None else str(path)
    buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(frames, scratch_dir=folder, existsok=True))
    collector = Collector(
        env, policy, frames_per_batch=frames, total_frames=frames, auto_register_policy_transforms=False
    )
    try:
        for drives in collector:
            buffer.extend(drives.select(*STORED).reshape(-1))
    finally:
        collector.shutdown()
    return buffer


def load_demonstrations(path: str | Path) -> TensorDictReplayBuffer:
    """The buffer that :func:`collect_demonstrations` stored in ``path``, memory-mapped.

    Raises:
        FileNotFoundError: there is none.
    """
    if not (Path(path) / "meta.json").is_file():
        raise FileNotFoundError(f"no demonstrations in {str(path)!r}; give a folder that collect_demonstrations wrote")
    return TensorDictReplayBuffer(storage=TensorStorage(TensorDict.load_memmap(path)))
