"""What stands around a town's streets: buildings, trees and lamp posts, and the ground they stand on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ldrl.towns.ground import SIDEWALK, Ground, stations
from ldrl.towns.noise import hash_uniform
from ldrl.towns.surface import CELL, LANE_SPACING, rasterise, sample

if TYPE_CHECKING:
    from ldrl.towns.town import Town

__all__ = ["NEARBY", "PROP_CELL", "REACH", "STOREY", "STYLES", "Scenery"]

REACH = 15.0
"""How far from the road there is scenery, m."""
LOT = 14.0
"""About the width of a lot, m."""
STOREY = 3.0
"""Height of a storey, m."""
STYLES = 6
"""Kinds of facades."""
TREES, POSTS = 8.0, 24.0
"""Between trees, and between lamp posts, along a lane, m."""
POST = (0.08, 0.35, 5.6, 5.9)
"""Radius of a lamp post, and radius, bottom and top of its lamp, m."""
PROP_CELL = 8.0
"""Edge of a cell of the map of props, m."""
NEARBY = 24
"""Props that a camera may see from a cell: the nearest ones."""


class Scenery(nn.Module):
    """A town's surroundings as tensors, the same for the same town and its seed.

    Along each lane the land behind the sidewalk is cut into lots: houses with the front at the sidewalk or behind a
    garden, of two to six storeys, or greens with trees. Behind them stands a hedge.

    Args:
        town: the town.

    Attributes:
        pyramid: ``[T]`` uint8, :class:`~ldrl.towns.ground.Material` plus shade of the ground's texels: of those of
            12.5 cm, of every second, and of every fourth, which are all that distant pixels can tell apart.
        corner: ``[2]`` float32, x and y, m.
        walls: ``[1, 2, H, W]`` float32: depth inside buildings and hedges (m, negative outside), and their height
            (m).
        facade: ``[H, W]`` uint8, the style of the building or hedge (``STYLES``) that fills the cell.
        props: ``[P, 6]`` float32: x, y, radius of the stem, radius, bottom and top of the crown, m.
        nearby: ``[h, w, 24]`` int64, the props nearest to the cells of 8 m, by distance.
    """

    pyramid: Tensor
    corner: Tensor
    walls: Tensor
    facade: Tensor
    props: Tensor
    nearby: Tensor

    def __init__(self, town: Town) -> None:
        super().__init__()
        self.seed = town.seed
        surface = rasterise(town.points.cpu(), town.headings.cpu(), town.half_width.cpu(), LANE_SPACING, REACH)
        beyond = surface.road_distance[0, 0]
        lots = _Lots(town, self.seed, surface.origin, surface.nearest_point, beyond)
        ground = Ground(town, self.seed, surface.origin, surface.nearest_point, beyond)
        props = _props(town, self.seed, surface.origin, beyond)
        extent = (torch.tensor(beyond.shape) * CELL / PROP_CELL).ceil().long().tolist()
        self._buffer("corner", surface.origin - CELL / 2)
        levels = [ground.materials(lots.green, lots.walls[0, 0])]
        levels += [levels[0][step // 2 :: step, step // 2 :: step] for step in (2, 4)]
        self.sizes = [level.shape for level in levels]
        # NumPy asks the system for huge pages, torch does not: without them cameras in large towns miss the page table.
        self._buffer("pyramid", torch.from_numpy(np.concatenate([level.flatten().numpy() for level in levels])))
        self._buffer("walls", lots.walls)
        self._buffer("facade", lots.facade)
        self._buffer("props", props)
        self._buffer("nearby", _nearby(props, self.corner, extent))
        self.to(town.points.device)

    def _buffer(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def ground(self, level: int = 0) -> Tensor:
        """Materials of texels of 12.5 cm, twice or four times as much (level 0, 1, 2), ``[4H, 4W] / 2**level`` uint8.

        Texel (0, 0) has its corner at ``corner``.
        """
        start = sum(height * width for height, width in self.sizes[:level])
        height, width = self.sizes[level]
        return self.pyramid[start : start + height * width].view(height, width)


class _Lots:
    """The lots along the lanes and what stands on them, on the raster of cells."""

    def __init__(self, town: Town, seed: int, origin: Tensor, nearest: Tensor, beyond: Tensor) -> None:
        lanes, arcs = stations(town)
        grid = torch.meshgrid(*map(torch.arange, nearest.shape), indexing="ij")
        offset = torch.stack(grid[::-1], -1) * CELL + origin - town.points.cpu()[nearest]
        heading, lane = town.headings.cpu()[nearest], lanes[nearest]
        arc = arcs[nearest] + offset[..., 0] * heading.cos() + offset[..., 1] * heading.sin()
        length = town.lane_length.cpu()[lane]
        count = (length / LOT).round().clamp(min=1)
        size = length / count
        number = (arc / size).floor().clamp(min=0).minimum(count - 1)
        lot = lane * 1024 + number.long()

        def draw(kind: int) -> Tensor:
            return hash_uniform(seed, lot, kind)

        def habit(kind: int) -> float:  # how often the town does so
            return float(hash_uniform(seed, kind))

        self.green = draw(1) < 0.08 + 0.2 * habit(1)
        garden = torch.where(draw(2) < 0.6 * habit(2), 2.5, 0.3)
        gap = torch.where(draw(3) < 0.8 * habit(3), 1.5, -100.0)
        storeys = 2 + (draw(4) * (1.5 + 4 * habit(4))).floor()
        to_side = torch.minimum(arc - number * size, (number + 1) * size - arc)
        house = torch.minimum(beyond - SIDEWALK - garden, to_side - gap)
        house = house.masked_fill(self.green | (beyond >= REACH - CELL), -REACH)
        hedge = beyond - (REACH - 1.0)
        is_house = house >= hedge
        height = torch.where(is_house, storeys * STOREY + draw(5), 3.0 + 2.0 * draw(6))
        self.walls = torch.stack((torch.maximum(house, hedge), height)).unsqueeze(0)
        self.facade = torch.where(is_house, (draw(7) * STYLES).long(), STYLES).to(torch.uint8)


def _props(town: Town, seed: int, origin: Tensor, beyond: Tensor) -> Tensor:
    """Trees and lamp posts on the verges, ``[P, 6]`` as :attr:`Scenery.props`."""
    points, headings, (_, arc) = town.points.cpu(), town.headings.cpu(), stations(town)
    number = torch.arange(len(points))
    post = (arc % POSTS < LANE_SPACING) & (arc >= POSTS / 2)
    often = 0.2 + 0.6 * float(hash_uniform(seed, 8))
    tree = (arc % TREES < LANE_SPACING) & (hash_uniform(seed, number, 21) < often) & ~post
    right = torch.stack((-headings.sin(), headings.cos()), -1)
    place = points + (town.half_width.cpu() + SIDEWALK - 0.5).unsqueeze(-1) * right
    size = hash_uniform(seed, number, 22)
    shape = torch.stack((0.12 + 0.1 * size, 1.2 + size, 1.9 + 0.6 * size, 4.5 + 2.5 * size), -1)
    shape = torch.where(post.unsqueeze(-1), torch.tensor(POST), shape)
    # Another lane's road may be where this one's verge would be.
    clear = sample(beyond[None, None], origin, place).squeeze(-1) > SIDEWALK - 1.0
    props = torch.cat((place, shape), -1)[(post | tree) & clear]
    missing = max(0, NEARBY - len(props))
    return torch.cat((props, torch.tensor([[1e6, 1e6, *POST]]).expand(missing, -1)))  # out of sight


def _nearby(props: Tensor, corner: Tensor, extent: list[int]) -> Tensor:
    """The props nearest to each cell of their map, ``[*extent, 24]`` int64."""
    y, x = torch.meshgrid(*map(torch.arange, extent), indexing="ij")
    centres = (torch.stack((x, y), -1) + 0.5) * PROP_CELL + corner
    _, nearby = cKDTree(props[:, :2].numpy()).query(centres.numpy(), k=NEARBY)
    return torch.from_numpy(nearby)
