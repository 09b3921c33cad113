"""The usual stack: a town, cars, labels, what the passenger says, and a dash camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, GymWrapper, InitTracker, Transform, TransformedEnv

from ldrl import keys
from ldrl.envs.camera import DashCamera
from ldrl.envs.episodes import Episode
from ldrl.envs.highway import HighwayTownEnv
from ldrl.envs.instruction import Instruction
from ldrl.envs.labels import SubtaskLabels
from ldrl.envs.segmenter import RoadSegmenter
from ldrl.envs.town import TownEnv
from ldrl.towns import Town

__all__ = ["Modality", "make_camera", "make_env", "make_highway_env"]

Modality = Literal["gs", "ps", "rgb"]


def make_camera(
    town: Town,
    modality: Modality = "gs",
    *,
    appearance: str | int = "clear",
    segmenter: str | Path | RoadSegmenter = "road-segmenter",
    seed: int = 0,
) -> Transform:
    """What draws the images of a modality, in an env or in a replay buffer.

    Args:
        town: what there is to see.
        modality: ``"gs"``, the road; ``"rgb"``; or ``"ps"``, the road that a :class:`~ldrl.envs.RoadSegmenter` sees in
            the rgb images.
        appearance: of what is seen in colour, see :class:`~ldrl.envs.DashCamera`.
        segmenter: what ``"ps"`` sees with: weights, or a :class:`~ldrl.envs.RoadSegmenter`.
        seed: of the appearances.

    Examples:
        >>> from tensordict import TensorDict
        >>> poses = TensorDict({("world", "pose"): torch.zeros(5, 3)}, [5])
        >>> make_camera(Town.load("town1"), "ps")(poses)["observation", "image"].shape
        torch.Size([5, 1, 88, 200])
    """
    if modality == "ps":
        seen = segmenter.clone() if isinstance(segmenter, RoadSegmenter) else RoadSegmenter(segmenter)
        return Compose(DashCamera(town, modality="rgb", appearance=appearance, seed=seed), seen)
    return DashCamera(town, modality=modality, appearance=appearance, seed=seed)


def make_env(
    town: str | Path | Town,
    num_cars: int | None = None,
    *,
    episodes: Sequence[Episode] | None = None,
    policy: TensorDictModuleBase | None = None,
    modality: Modality | None = None,
    appearance: str | int = "clear",
    segmenter: str | Path | RoadSegmenter = "road-segmenter",
    max_steps: int = 1000,
    traffic: int = 0,
    device: torch.device | str = "cpu",
    seed: int = 0,
) -> TransformedEnv:
    """A town with labels, instructions and a dash camera, ready for an agent.

    Args:
        town: a town, the name of one or the path of an OpenDRIVE map.
        num_cars: the batch size; left out when ``episodes`` are given.
        episodes: one per row, with their instructions; None roams and draws training sentences.
        policy: what is to drive; the env then holds its memory, and draws images only if it reads them.
        modality: of the images, see :func:`make_camera`; None for what the policy is made for, or ``"gs"``.
        appearance: of what is seen in colour, see :class:`~ldrl.envs.DashCamera`.
        segmenter: what ``"ps"`` sees with: weights, or a :class:`~ldrl.envs.RoadSegmenter`.
        max_steps: length of a roaming episode.
        traffic: other cars in each world.
        device: where the tensors are.
        seed: of the env, the instructions and the appearances; ``env.set_seed`` reaches only the first, so parallel
            workers need one each.

    Examples:
        >>> sorted(make_env("town1", num_cars=2).reset().keys())
        ['done', 'end_of_subtask', 'instruction_tokens', 'observation', 'subtask', 'terminated', 'truncated', 'world']
    """
    town = town if isinstance(town, Town) else Town.load(town)
    env = TownEnv(town, num_cars, episodes=episodes, max_steps=max_steps, traffic=traffic, device=device, seed=seed)
    said = None if episodes is None else [episode.instruction for episode in episodes]
    camera = partial(make_camera, env.town, appearance=appearance, segmenter=segmenter, seed=seed)
    return _stack(env, env.town, Instruction(said, seed=seed), policy, modality, camera)


def make_highway_env(
    town: str | Path | Town,
    *,
    episode: Episode | None = None,
    policy: TensorDictModuleBase | None = None,
    modality: Modality | None = None,
    appearance: str | int = "clear",
    segmenter: str | Path | RoadSegmenter = "road-segmenter",
    config: dict | None = None,
    seed: int = 0,
) -> TransformedEnv:
    """The same on highway-env: one car, batch size ``[]``.

    Args:
        town: a town, the name of one or the path of an OpenDRIVE map.
        episode: with its instruction; None roams and draws training sentences.
        policy: what is to drive; the env then holds its memory, and draws images only if it reads them.
        modality: of the images, see :func:`make_camera`; None for what the policy is made for, or ``"gs"``.
        appearance: of what is seen in colour, see :class:`~ldrl.envs.DashCamera`.
        segmenter: what ``"ps"`` sees with: weights, or a :class:`~ldrl.envs.RoadSegmenter`.
        config: further settings of :class:`~ldrl.envs.HighwayTownEnv`, such as ``vehicles_count``.
        seed: of the env, the instructions and the appearances; ``env.set_seed`` reaches only the first, so parallel
            workers need one each.

    Examples:
        >>> make_highway_env("town1", config={"vehicles_count": 3}).reset()["world", "traffic"].shape
        torch.Size([3, 4])
    """
    town = town if isinstance(town, Town) else Town.load(town)
    env = GymWrapper(HighwayTownEnv((config or {}) | {"town": town, "episode": episode}))
    env.set_seed(seed)
    said = None if episode is None else [episode.instruction]
    camera = partial(make_camera, town, appearance=appearance, segmenter=segmenter, seed=seed)
    return _stack(env, town, Instruction(said, seed=seed), policy, modality, camera)


def _stack(
    env: EnvBase,
    town: Town,
    instruction: Instruction,
    policy: TensorDictModuleBase | None,
    modality: Modality | None,
    camera: Callable[[Modality], Transform],
) -> TransformedEnv:
    transforms = [SubtaskLabels(town), instruction]
    if policy is None or keys.IMAGE in policy.in_keys:
        transforms.append(camera(getattr(policy, "modality", "gs") if modality is None else modality))
    if policy is not None and hasattr(policy, "make_tensordict_primer"):
        transforms += [InitTracker(), policy.make_tensordict_primer()]
    return TransformedEnv(env, Compose(*transforms))
