"""Lines of sight of the dash camera: where they meet the ground, walls, stems and cars."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ldrl.envs import vehicle
from ldrl.towns.scenery import PROP_CELL, TEXELS, Material, Scenery
from ldrl.towns.surface import CELL

__all__ = ["ABOVE", "FOCAL", "FORWARD", "HEIGHT", "HORIZON", "WIDTH", "Cars", "Mount", "Props", "Sight"]

HEIGHT, WIDTH = 88, 200
HORIZON = HEIGHT // 2
FOCAL = WIDTH / 2 / math.tan(math.radians(90) / 2)
"""Focal length: the camera sees 90 degrees across, pixels."""
FORWARD, ABOVE = 1.6, 1.7
"""Mount: ahead of the vehicle's origin, and above the road, m."""
FARTHEST = 120.0
"""Walls are seen up to here, m."""
STEP = 0.08
"""Steps in which they are looked for, as a part of the depth."""
CAR_HEIGHT = 1.5
"""m; less than the camera's."""
CARS_IN_SIGHT = 8
"""Other cars drawn at most: the nearest ahead."""
STEMS_IN_SIGHT = 8
"""Trees and posts whose stems are drawn: the nearest ahead."""
LAYERS = 3
"""Cars, and trees or posts, that are drawn one behind the other in a column of pixels."""


class Mount(NamedTuple):
    """Cameras: where they stand and where they look.

    Attributes:
        xy: ``[N, 2]``, m.
        cos, sin: ``[N, 1]``, of the heading.
    """

    xy: Tensor
    cos: Tensor
    sin: Tensor

    @classmethod
    def on(cls, pose: Tensor) -> Mount:
        """The cameras of vehicles at ``pose``, ``[N, 3]``."""
        cos, sin = pose[:, 2:].cos(), pose[:, 2:].sin()
        return cls(pose[:, :2] + FORWARD * torch.cat((cos, sin), -1), cos, sin)

    def ahead_and_right(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates of points ``[N, P, 2]`` as seen from here, two ``[N, P]``, m."""
        dx, dy = (xy - self.xy.unsqueeze(1)).unbind(-1)
        return dx * self.cos + dy * self.sin, dy * self.cos - dx * self.sin

    def map(self, rays: Tensor, origin: Tensor, per_metre: float) -> tuple[Tensor, Tensor]:
        """Map coordinates of the points ``rays``, ``[2, R]`` metres ahead and to the right: two ``[N, R]``."""
        start = (self.xy - origin) * per_metre
        cos, sin = self.cos * per_metre, self.sin * per_metre
        shape = (len(start), rays.shape[1])
        x = torch.addmm(start[:, :1].expand(shape), torch.cat((cos, -sin), 1), rays)
        y = torch.addmm(start[:, 1:].expand(shape), torch.cat((sin, cos), 1), rays)
        return x, y


class Props(NamedTuple):
    """Trees and posts ahead of each camera, nearest first.

    Attributes:
        index: ``[N, P]`` int64, into :attr:`~ldrl.towns.scenery.Scenery.props`.
        ahead: ``[N, P, 1]``, depth, infinite for those that are not ahead, m.
        aside: ``[N, P, 200]``, how far right of the axis each column's line of sight passes, m.
    """

    index: Tensor
    ahead: Tensor
    aside: Tensor


class Cars(NamedTuple):
    """Other cars in each column of pixels, nearest first; depths are infinite where there is none.

    Attributes:
        near: ``[N, 3, 200]``, depth where the line of sight enters, m.
        far: ``[N, 3, 200]``, depth where it leaves, m.
        car: ``[N, 3, 200]`` int64, index of the car.
    """

    near: Tensor
    far: Tensor
    car: Tensor


class Sight(nn.Module):
    """Lines of sight through all pixels of a camera without pitch or roll above a flat ground.

    Pixel ``(row, column)`` looks along ``(1, (column + 0.5 - 100) / f, (row + 0.5 - 44) / f)`` ahead, right and down,
    with the focal length ``f = 100`` pixels. So all that stands upright is found once per column.

    A wall stands on its footprint, so a column of pixels meets it where the ground below first is one. Where rows lie
    far apart, near the horizon, the ground between them is looked at too.

    Attributes:
        slope: ``[200]``, metres right per metre ahead of each column.
        down: ``[44]``, metres down per metre ahead of the rows below the horizon, from the horizon down.
        reach: ``[44]``, how far ahead these rows meet the ground, m.
        depths: ``[D + 1]``, those of the rows, more depths between them, and infinity, ascending, m.
        far_depths: ``[20]``, where higher buildings are looked for behind lower ones, m.
        far_rays: ``[2, 20 * 200]``, points at these depths along each column, ahead and to the right, m.
    """

    slope: Tensor
    down: Tensor
    reach: Tensor
    depths: Tensor
    rays: Tensor
    rows: Tensor
    rank: Tensor
    far_depths: Tensor
    far_rays: Tensor

    def __init__(self) -> None:
        super().__init__()
        slope = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
        down = (torch.arange(HORIZON) + 0.5) / FOCAL
        reach = ABOVE / down
        between = [reach]
        for near, far in pairwise(reach.flip(0).clamp(max=FARTHEST).tolist()):
            count = math.ceil((far / near - 1) / STEP)
            between.append(torch.linspace(near, far, count + 1)[1:-1])
        depths = torch.cat(between).sort().values
        self._buffer("slope", slope)
        self._buffer("down", down)
        self._buffer("reach", reach)
        self._buffer("depths", nn.functional.pad(depths, (0, 1), value=math.inf))
        self._buffer("rows", torch.searchsorted(depths, reach))
        self._buffer("far_depths", 10 * (FARTHEST / 10) ** torch.linspace(0, 1, 20))
        self._buffer("rank", torch.arange(len(depths), 0, -1, dtype=torch.uint8).unsqueeze(-1))
        self._buffer("rays", _fan(depths, slope))
        self._buffer("far_rays", _fan(self.far_depths, slope))

    def _buffer(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def ground(self, scenery: Scenery, mount: Mount) -> tuple[Tensor, Tensor]:
        """What the ground is made of, as if nothing stood on it, and where the first wall is.

        Returns:
            ``[N, 44, 200]`` uint8 :class:`~ldrl.towns.scenery.Material` below the horizon, from the horizon down, and
            ``[N, 200]`` int64, the first of ``depths`` inside a wall, the last of all where there is none.
        """
        height, width = scenery.ground.shape
        x, y = mount.map(self.rays, scenery.corner, TEXELS / CELL)
        index = y.clamp_(0, height - 1).int().mul_(width).add_(x.clamp_(0, width - 1).int())
        ground = scenery.ground.view(-1).index_select(0, index.view(-1)).view(-1, len(self.rank), WIDTH)
        first = len(self.rank) - ((ground == Material.WALL) * self.rank).amax(1).long()
        return ground[:, self.rows], first

    def props(self, scenery: Scenery, mount: Mount, count: int) -> Props:
        """The nearest ``count`` trees and posts ahead."""
        rows, columns = scenery.nearby.shape[:2]
        cell = ((mount.xy - scenery.corner) / PROP_CELL).long()
        x, y = cell[:, 0].clamp(0, columns - 1), cell[:, 1].clamp(0, rows - 1)
        nearby = scenery.nearby[y, x]
        ahead, right = mount.ahead_and_right(scenery.props[nearby, :2])
        ahead, which = ahead.masked_fill_(ahead < 0.5, torch.inf).topk(count, largest=False)
        right, ahead = right.gather(1, which).unsqueeze(-1), ahead.unsqueeze(-1)
        return Props(nearby.gather(1, which), ahead, torch.addcmul(-right, ahead, self.slope))

    def obstacle(self, scenery: Scenery, props: Props, wall: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest wall or stem in each column: its depth (m), and which of ``props`` it is, -1 for a wall.

        Args:
            scenery: what there is to see.
            props: at least ``STEMS_IN_SIGHT``; the stems of further ones are not looked at.
            wall: ``[N, 200]`` int64, the first of ``depths`` inside a wall.

        Returns:
            Two ``[N, 200]``; the depth is infinite where there is nothing.
        """
        radius = scenery.props[props.index[:, :STEMS_IN_SIGHT], 2].unsqueeze(-1)
        hit = props.aside[:, :STEMS_IN_SIGHT].abs() < radius
        stem, which = torch.where(hit, props.ahead[:, :STEMS_IN_SIGHT], torch.inf).min(1)
        wall_depth = self.depths[wall]
        return torch.minimum(wall_depth, stem), torch.where(stem < wall_depth, which, -1)

    def sees_ground(self, nearest: Tensor) -> Tensor:
        """Which pixels below the horizon see the ground, ``[N, 44, 200]`` bool, given :meth:`obstacle`'s depth."""
        return self.reach.unsqueeze(-1) < nearest.unsqueeze(1)

    def cars(self, mount: Mount, traffic: Tensor) -> Cars:
        """The nearest of other cars, ``[N, P, 4]``, in each column."""
        ahead, right = mount.ahead_and_right(traffic[..., :2])
        seen = (ahead > -vehicle.LENGTH) & (right.abs() < ahead + 2 * vehicle.LENGTH)  # not where there is no car: NaN
        distance, which = torch.where(seen, ahead, torch.inf).topk(min(CARS_IN_SIGHT, ahead.shape[1]), largest=False)
        heading = traffic[..., 2].gather(1, which)
        cos, sin = heading.cos(), heading.sin()
        # The line of sight in the car's own frame: a start and a direction along its length and its width.
        to_x, to_y = (mount.xy.unsqueeze(1) - traffic[..., :2].gather(1, which.unsqueeze(-1).expand(-1, -1, 2))).unbind(
            -1
        )
        look_x, look_y = mount.cos - self.slope * mount.sin, mount.sin + self.slope * mount.cos
        start = torch.stack((to_x * cos + to_y * sin, to_y * cos - to_x * sin)).unsqueeze(-1)
        cos, sin, look_x, look_y = cos.unsqueeze(-1), sin.unsqueeze(-1), look_x.unsqueeze(1), look_y.unsqueeze(1)
        look = torch.stack((look_x * cos + look_y * sin, look_y * cos - look_x * sin))
        half = look.new_tensor([vehicle.LENGTH / 2, vehicle.WIDTH / 2]).view(2, 1, 1, 1)
        reach = half / look.abs()
        middle = -start / look
        near, far = (middle - reach).amax(0), (middle + reach).amin(0)
        met = (near < far) & (near > 0.1) & distance.isfinite().unsqueeze(-1)
        near, layer = torch.where(met, near, torch.inf).topk(min(LAYERS, near.shape[1]), 1, largest=False)
        return Cars(near, far.gather(1, layer), which.unsqueeze(-1).expand_as(met).gather(1, layer))

    def covers(self, cars: Cars, hidden_beyond: Tensor) -> Tensor:
        """Which pixels below the horizon each layer of cars covers, ``[N, 3, 44, 200]`` bool.

        Args:
            cars: the cars.
            hidden_beyond: ``[N, 200]``, depth of the nearest other thing in the column, m.
        """
        near = torch.where(cars.near < hidden_beyond.unsqueeze(1), cars.near, torch.inf)
        top = torch.where(near.isfinite(), (ABOVE - CAR_HEIGHT) / cars.far, torch.inf).unsqueeze(2)
        down = self.down.unsqueeze(-1)
        return (down >= top) & (down <= ABOVE / near.unsqueeze(2))


def _fan(depths: Tensor, slopes: Tensor) -> Tensor:
    """Points ahead and to the right at each depth along each column, ``[2, D * 200]``, depth by depth."""
    ahead = depths.unsqueeze(-1).expand(-1, len(slopes))
    return torch.stack((ahead, ahead * slopes)).flatten(1)
