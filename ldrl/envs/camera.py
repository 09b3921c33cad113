"""The dash camera: what the car sees, drawn from its pose."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import grid_sample
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import Transform

from ldrl import keys
from ldrl.towns import Town
from ldrl.towns.surface import CELL

__all__ = ["HEIGHT", "WIDTH", "DashCamera", "shift"]

HEIGHT, WIDTH = 88, 200
FIELD_OF_VIEW = math.radians(90)
FORWARD, ABOVE = 1.6, 1.7
"""Mount: ahead of the vehicle's origin, and above the road, m."""
FRAMES_AT_ONCE = 64
"""Frames drawn together: few enough that their rays stay in the processor's cache."""


def shift(pose: Tensor, lateral: Tensor | float, yaw: Tensor | float) -> Tensor:
    """Move poses sideways and turn them.

    Args:
        pose: ``[*B, 3]``: x, y (m), heading (rad).
        lateral: ``[*B]`` or a number, to the right, m.
        yaw: ``[*B]`` or a number, to the right, rad.

    Returns:
        ``[*B, 3]``.

    Examples:
        >>> shift(torch.zeros(3), lateral=1.0, yaw=0.5)
        tensor([0.0000, 1.0000, 0.5000])
    """
    x, y, heading = pose.unbind(-1)
    return torch.stack((x - heading.sin() * lateral, y + heading.cos() * lateral, heading + yaw), -1)


class DashCamera(Transform):
    """Draws the 88x200 image of a forward camera from ``("world", "pose")``, the whole batch at once.

    The same transform serves an env (draw now) and a replay buffer (draw when sampled). The camera stands 1.6 m ahead
    of the vehicle's origin and 1.7 m above a flat road, has no pitch, and sees 90 degrees across. The modality is
    ``gs``, a binary segmentation: 255 where the ray through the pixel's centre meets the drivable surface.

    Args:
        town: what there is to see.
        lateral: offset of the mount to the right, m.
        yaw: turn of the mount to the right, rad.

    Examples:
        >>> camera = DashCamera(Town.load("town1"))
        >>> camera.draw(torch.tensor([[200.0, 2.0, 3.14]])).shape
        torch.Size([1, 1, 88, 200])
    """

    rays: Tensor

    def __init__(self, town: Town, *, lateral: float = 0.0, yaw: float = 0.0) -> None:
        super().__init__(in_keys=[keys.POSE], out_keys=[keys.IMAGE])
        self.town = town
        self.lateral = lateral
        self.yaw = yaw
        self.register_buffer("rays", ground_rays(), persistent=False)

    def draw(self, pose: Tensor) -> Tensor:
        """Draw images.

        Args:
            pose: of the vehicle's origin, ``[*B, 3]`` float32: x, y (m), heading (rad).

        Returns:
            ``[*B, 1, 88, 200]`` uint8, 0 or 255.
        """
        pose = shift(pose, self.lateral, self.yaw)
        images = pose.new_zeros((pose[..., 0].numel(), 1, HEIGHT, WIDTH), dtype=torch.uint8)
        below_horizon = images[:, :, HEIGHT // 2 :]
        chunks = pose.reshape(-1, 3).split(FRAMES_AT_ONCE)
        for chunk, target in zip(chunks, below_horizon.split(FRAMES_AT_ONCE), strict=True):
            target.copy_(self._on_road(chunk))
        return images.mul_(255).view(*pose.shape[:-1], 1, HEIGHT, WIDTH)

    def _on_road(self, pose: Tensor) -> Tensor:
        """Whether the rays below the horizon meet the road: ``[N, 1, 44, 200]`` bool."""
        raster = self.town.road_distance.expand(len(pose), -1, -1, -1)
        height, width = raster.shape[-2:]
        cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
        # A ray (forward, right, 1) times this matrix is the raster coordinate that grid_sample reads, in [-1, 1].
        axes = torch.stack((cos, sin, -sin, cos), -1).view(-1, 2, 2)
        matrix = torch.cat((axes, (pose[:, :2] - self.town.raster_origin).unsqueeze(1)), 1)
        matrix = matrix * (2 / CELL / matrix.new_tensor([width - 1, height - 1]))
        grid = self.rays @ matrix
        grid = grid.sub_(1).view(-1, HEIGHT // 2, WIDTH, 2)
        return grid_sample(raster, grid, padding_mode="border", align_corners=True) < 0

    def _apply_transform(self, pose: Tensor) -> Tensor:
        return self.draw(pose)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the image."""
        shape = (*observation_spec.shape, 1, HEIGHT, WIDTH)
        observation_spec[keys.IMAGE] = Bounded(0, 255, shape, observation_spec.device, torch.uint8)
        return observation_spec


def ground_rays() -> Tensor:
    """Where the rays through the pixels below the horizon meet the road, from the vehicle's origin.

    Pixel ``(row, column)`` looks along ``(1, (column + 0.5 - 100) / f, (row + 0.5 - 44) / f)`` forward, right and
    down, with the focal length ``f = 100`` pixels.

    Returns:
        ``[8800, 3]`` float32: forward and right (m), and 1; row by row from the horizon down.
    """
    focal = WIDTH / 2 / math.tan(FIELD_OF_VIEW / 2)
    down = (torch.arange(HEIGHT // 2) + 0.5) / focal
    right = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / focal
    distance = (ABOVE / down).unsqueeze(-1).expand(-1, WIDTH)
    return torch.stack((FORWARD + distance, distance * right, torch.ones_like(distance)), -1).view(-1, 3)
