"""Lines of sight of the dash camera: where they meet the ground, walls, stems and cars."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ldrl.envs import vehicle
from ldrl.towns.ground import TEXELS
from ldrl.towns.scenery import PROP_CELL, Scenery
from ldrl.towns.surface import CELL

__all__ = [
    "ABOVE",
    "FOCAL",
    "FORWARD",
    "HEIGHT",
    "HORIZON",
    "WIDTH",
    "Cars",
    "Mount",
    "Obstacles",
    "Props",
    "Sight",
    "rows_within",
]

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
COARSER = (14.0, 28.0)
"""Beyond these depths the ground is seen in texels of 25 and of 50 cm, up to two pixels wide, m."""
CAR_HEIGHT = 1.5
"""m; less than the camera's."""
CARS_IN_SIGHT = 8
"""Other cars drawn at most: the nearest in the field of view."""
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
        ahead, right = rays
        # No matrix product: its rounding would depend on how many cameras there are.
        x = (cos * ahead).addcmul_(-sin, right).add_(start[:, :1])
        y = (sin * ahead).addcmul_(cos, right).add_(start[:, 1:])
        return x, y


class Props(NamedTuple):
    """Trees and posts ahead of each camera, nearest first.

    Attributes:
        prop: ``[N, P]`` int64, index into :attr:`~ldrl.towns.scenery.Scenery.props`.
        ahead: ``[N, P, 1]``, depth, infinite for those that are not ahead, m.
        aside: ``[N, P, 200]``, how far right of the axis each column's line of sight passes, m.
    """

    prop: Tensor
    ahead: Tensor
    aside: Tensor


class Obstacles(NamedTuple):
    """The nearest wall or stem in each column of pixels.

    Attributes:
        depth: ``[N, 200]``, infinite where there is none, m.
        stem: ``[N, 200]`` int64, which of the props it is, -1 if none.
        rows: ``[N, 200]`` int16, rows below the horizon that it hides.
    """

    depth: Tensor
    stem: Tensor
    rows: Tensor


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
        row: ``[44, 1]`` int16, numbers of rows, counted from the horizon up or down.
        reach: ``[44]``, how far ahead the rows below the horizon meet the ground, m.
        depths: ``[D + 1]``, those of the rows, more depths between them, and infinity, ascending, m.
        rays: ``[2, D * 200]``, points along each column at the depths between rows, then at the rows', m.
        levels: how many of these depths read the coarsest ground, it or the next, and any.
        rows_beyond: ``[D + 1]`` int16, rows that lie beyond each of ``depths``.
        rank: ``[D, 1]`` uint8, of the depths of ``rays``, the nearest highest.
        far_depths: ``[24]``, where higher buildings are looked for behind lower ones, m.
        far_rays: ``[2, 24 * 200]``, points at these depths along each column, ahead and to the right, m.
    """

    slope: Tensor
    row: Tensor
    reach: Tensor
    depths: Tensor
    rays: Tensor
    rows_beyond: Tensor
    rank: Tensor
    far_depths: Tensor
    far_rays: Tensor

    def __init__(self) -> None:
        super().__init__()
        slope = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
        down = (torch.arange(HORIZON) + 0.5) / FOCAL
        reach = ABOVE / down
        depths = []
        for near, far in pairwise(reach.flip(0).clamp(max=FARTHEST).tolist()):
            count = math.ceil((far / near - 1) / STEP)
            depths.append(torch.linspace(near, far, count + 1)[1:-1])
        between = torch.cat(depths)
        ascending, order = torch.cat((between, reach)).sort()
        # From coarse to fine; what lies between rows is looked at coarsely.
        self.levels = [len(between) + int((reach > depth).sum()) for depth in (*COARSER[::-1], 0.0)]
        self._buffer("slope", slope)
        self._buffer("reach", reach)
        self._buffer("depths", nn.functional.pad(ascending, (0, 1), value=math.inf))
        self._buffer("row", torch.arange(HORIZON, dtype=torch.int16).unsqueeze(-1))
        self._buffer("rows_beyond", (reach >= self.depths.unsqueeze(-1)).sum(-1).to(torch.int16))
        self._buffer("far_depths", 4 * (FARTHEST / 4) ** torch.linspace(0, 1, 24))
        self._buffer("rank", (len(order) - order.argsort()).to(torch.uint8).unsqueeze(-1))
        self._buffer("rays", _fan(torch.cat((between, reach)), slope))
        self._buffer("far_rays", _fan(self.far_depths, slope))

    def _buffer(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def ground(self, scenery: Scenery, mount: Mount) -> tuple[Tensor, Tensor]:
        """What the ground is made of, as if nothing stood on it, and where the first wall is.

        Returns:
            ``[N, 44, 200]`` uint8 :class:`~ldrl.towns.ground.Material` below the horizon, from the horizon down, and
            ``[N, 200]`` int64, the first of ``depths`` inside a wall, the last of all where there is none.
        """
        pieces, start = [], 0
        for level, end in zip((2, 1, 0), self.levels, strict=True):
            texels = scenery.ground(level)
            height, width = texels.shape
            rays = self.rays[:, start * WIDTH : end * WIDTH]
            x, y = mount.map(rays, scenery.corner, TEXELS / CELL / 2**level)
            index = y.clamp_(0, height - 1).int().mul_(width).add_(x.clamp_(0, width - 1).int())
            pieces.append(texels.view(-1).index_select(0, index.view(-1)).view(-1, end - start, WIDTH))
            start = end
        ground = torch.cat(pieces, 1)
        first = len(self.rank) - ((ground >> 7) * self.rank).amax(1).long()  # the highest bit says wall
        return ground[:, -HORIZON:], first

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

    def obstacles(self, scenery: Scenery, props: Props, wall: Tensor) -> Obstacles:
        """The nearest wall or stem in each column.

        Args:
            scenery: what there is to see.
            props: at least ``STEMS_IN_SIGHT``; the stems of further ones are not looked at.
            wall: ``[N, 200]`` int64, the first of ``depths`` inside a wall.
        """
        radius = scenery.props[props.prop[:, :STEMS_IN_SIGHT], 2].unsqueeze(-1)
        hit = props.aside[:, :STEMS_IN_SIGHT].abs() < radius
        stem, found = (nearest.squeeze(1) for nearest in nearest_first(hit, 1))
        depth = torch.where(found, props.ahead.squeeze(-1).gather(1, stem), torch.inf)
        nearer = depth < self.depths[wall]
        rows = torch.where(nearer, rows_within(ABOVE / depth), self.rows_beyond[wall])
        return Obstacles(torch.where(nearer, depth, self.depths[wall]), torch.where(nearer, stem, -1), rows)

    def within(self, rows: Tensor) -> Tensor:
        """Which pixels lie in the first ``rows`` rows from the horizon.

        Args:
            rows: ``[*B, 200]`` int16.

        Returns:
            ``[*B, 44, 200]`` int16: -1, all bits, or 0. Choosing by such a mask (:func:`choose`) takes a fifth of the
            time that comparing and ``torch.where`` take on a CPU.
        """
        return (self.row - rows.unsqueeze(-2)).bitwise_right_shift_(15)

    def cars(self, mount: Mount, traffic: Tensor) -> Cars:
        """The nearest of other cars, ``[N, P, 4]``, in each column."""
        ahead, right = mount.ahead_and_right(traffic[..., :2])
        radius = math.hypot(vehicle.LENGTH, vehicle.WIDTH) / 2
        seen = (ahead > -radius) & (right.abs() < ahead + math.sqrt(2) * radius)  # not where there is no car: NaN
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
        layer, found = nearest_first(met, LAYERS)
        near = torch.where(found, near.gather(1, layer), torch.inf)
        return Cars(near, far.gather(1, layer), which.unsqueeze(-1).expand_as(met).gather(1, layer))

    def covers(self, cars: Cars, obstacles: Obstacles) -> Tensor:
        """Which pixels below the horizon each layer of cars covers: a mask ``[N, 3, 44, 200]`` as of :meth:`within`."""
        first, last = rows_within((ABOVE - CAR_HEIGHT) / cars.far), rows_within(ABOVE / cars.near)
        last = torch.where(cars.near < obstacles.depth.unsqueeze(1), last, 0)
        return self.within(last) & ~self.within(first)


def rows_within(slope: Tensor) -> Tensor:
    """How many rows from the horizon look less steeply up or down than ``slope`` (m per m), int16."""
    return (slope * FOCAL + 0.5).clamp_(0, HORIZON).to(torch.int16)


def nearest_first(seen: Tensor, layers: int) -> tuple[Tensor, Tensor]:
    """The first few that are seen in each column; what ``topk`` would find in ten times the time.

    Args:
        seen: ``[N, P, 200]`` bool, in the order of their distance.
        layers: how many to find.

    Returns:
        ``[N, layers, 200]`` int64 index into P, and bool, whether there is one; where there is none, the index is 0.
    """
    rank = seen * torch.arange(seen.shape[1], 0, -1, dtype=torch.int16, device=seen.device).unsqueeze(-1)
    found = []
    for _ in range(layers):
        best = rank.amax(1, keepdim=True)
        found.append(best)
        rank = rank * (rank < best)
    best = torch.cat(found, 1).long()
    return (seen.shape[1] - best) % seen.shape[1], best > 0


def choose(mask: Tensor, chosen: Tensor, other: Tensor) -> Tensor:
    """``chosen`` where the mask's bits are set, else ``other``; all integers."""
    return (mask & (chosen ^ other)).bitwise_xor_(other)


def _fan(depths: Tensor, slopes: Tensor) -> Tensor:
    """Points ahead and to the right at each depth along each column, ``[2, D * 200]``, depth by depth."""
    ahead = depths.unsqueeze(-1).expand(-1, len(slopes))
    return torch.stack((ahead, ahead * slopes)).flatten(1)
