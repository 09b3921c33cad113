"""What a town looks like: the ground's materials, the buildings along its streets, trees and lamp posts."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ldrl.subtasks import SubTask
from ldrl.towns.surface import CELL, rasterise

if TYPE_CHECKING:
    from ldrl.towns.town import Town

__all__ = ["Material", "Scenery", "hash_uniform"]

TEXELS = 4
"""Texels of the ground along the edge of a raster cell: they measure 12.5 cm."""
REACH = 15.0
"""How far from the road there is scenery, m."""
SIDEWALK = 4.0
"""Width of the sidewalk, m."""
TILE = 512
"""Edge of a texture that is laid out again and again, texels."""
STOREY = 3.0
"""Height of a storey, m."""
STYLES = 6
"""Kinds of facades."""
PROP_CELL = 8.0
"""Edge of a cell of the map of props, m."""
NEARBY = 24
"""Props that a camera may see from a cell: the nearest ones."""


class Material(IntEnum):
    """What a piece of ground is made of; all up to ``STOP_LINE`` are road, and on ``WALL`` stands a building."""

    ASPHALT = 0  # six shades
    PATCH = 6  # two shades
    EDGE_LINE = 8
    CENTRE_LINE = 9
    CENTRE_GAP = 10  # between the dashes of a centre line
    LANE_LINE = 11
    STOP_LINE = 12
    KERB = 13
    SIDEWALK = 14  # three shades
    GRASS = 17  # four shades
    YARD = 21  # three shades
    WALL = 128  # the only one with this bit


class Scenery(nn.Module):
    """A town's surroundings as tensors, the same for the same town and seed.

    Along each lane the land behind the sidewalk is cut into lots: houses with the front at the sidewalk or behind a
    garden, of two to six storeys, or greens with trees. Behind them stands a hedge.

    Args:
        town: the town.
        seed: of all that is drawn; None takes it from the town's name.

    Attributes:
        ground: ``[4H, 4W]`` uint8 :class:`Material`, plus its shade, of texels of 12.5 cm; texel (0, 0) has its corner
            at ``corner``.
        corner: ``[2]`` float32, x and y, m.
        walls: ``[1, 2, H, W]`` float32: depth inside buildings and hedges (m, negative outside), and their height
            (m).
        facade: ``[H, W]`` uint8, the style of the building or hedge (``STYLES``) that fills the cell.
        props: ``[P, 6]`` float32: x, y, radius of the stem, radius, bottom and top of the crown, m.
        nearby: ``[h, w, 24]`` int64, the props nearest to the cells of 8 m, by distance.
    """

    ground: Tensor
    corner: Tensor
    walls: Tensor
    facade: Tensor
    props: Tensor
    nearby: Tensor

    def __init__(self, town: Town, seed: int | None = None) -> None:
        super().__init__()
        self.seed = zlib.crc32(town.name.encode()) if seed is None else seed
        land = _Land(town, self.seed)
        self._buffer("corner", land.origin - CELL / 2)
        self._buffer("ground", land.ground())
        self._buffer("walls", land.walls)
        self._buffer("facade", land.facade)
        props, nearby = land.props()
        self._buffer("props", props)
        self._buffer("nearby", nearby)
        self.to(town.points.device)

    def _buffer(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)


def hash_uniform(*values: Tensor | int) -> Tensor:
    """Numbers in [0, 1) that look random and depend on nothing but the integers given.

    Args:
        values: ``[*B]`` int64 or numbers, broadcast together.

    Returns:
        ``[*B]`` float32.

    Examples:
        >>> bool(hash_uniform(torch.arange(1000), 7).mean().sub(0.5).abs() < 0.05)
        True
    """
    mixed = torch.tensor(0)
    for value in values:
        mixed = (mixed.to(value.device) if isinstance(value, Tensor) else mixed) ^ value
        for multiplier in (0x2545F4914F6CDD1D, 0x369DEA0F31A53F85):  # integers wrap around
            mixed = mixed * multiplier
            mixed = mixed ^ (mixed >> 31 & 0x1FFFFFFFF)
    return (mixed >> 16 & 0xFFFFFF).float() / 0x1000000


class _Land:
    """The town's surroundings under construction."""

    def __init__(self, town: Town, seed: int) -> None:
        self.town, self.seed = town, seed
        self.points, self.headings = town.points.cpu(), town.headings.cpu()
        self.half_width = town.half_width.cpu()
        self.lane = torch.searchsorted(town.lane_first.cpu(), torch.arange(len(self.points)), right=True) - 1
        since = torch.arange(len(self.points)) - town.lane_first.cpu()[self.lane]
        self.arc = since * town.lane_spacing.cpu()[self.lane]
        self.length = town.lane_length.cpu()
        surface = rasterise(self.points, self.headings, self.half_width, 0.5, REACH)
        self.origin, self.nearest = surface.origin, surface.nearest_point
        self.beyond = surface.road_distance[0, 0]
        self.patched = self._random(self.lane, (self.arc / 5).long(), 11) < 0.08
        self.sides = self._side_lines()
        self._build()

    def _random(self, *values: Tensor | int) -> Tensor:
        return hash_uniform(self.seed, *values)

    def _lot(self, lane: Tensor, arc: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Number of the lot beside a lane's station, and the distances to its two sides."""
        count = (self.length[lane] / 14.0).round().clamp(min=1)
        size = self.length[lane] / count
        number = (arc / size).floor().clamp(min=0).minimum(count - 1)
        return lane * 1024 + number.long(), arc - number * size, (number + 1) * size - arc

    def _build(self) -> None:
        """Walls, heights and facades on the raster of cells."""
        height, width = self.nearest.shape
        grid = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        offset = torch.stack(grid[::-1], -1) * CELL + self.origin - self.points[self.nearest]
        heading = self.headings[self.nearest]
        along = offset[..., 0] * heading.cos() + offset[..., 1] * heading.sin()
        lane = self.lane[self.nearest]
        lot, left, right = self._lot(lane, self.arc[self.nearest] + along)
        self.green = self._random(lot, 1) < 0.08 + 0.2 * self._random(1)
        garden = torch.where(self._random(lot, 2) < 0.6 * self._random(2), 2.5, 0.3)
        gap = torch.where(self._random(lot, 3) < 0.8 * self._random(3), 1.5, -100.0)
        storeys = 2 + (self._random(lot, 4) * (1.5 + 4 * self._random(4))).floor()
        house = torch.minimum(self.beyond - SIDEWALK - garden, torch.minimum(left, right) - gap)
        house = house.masked_fill(self.green | (self.beyond >= REACH - 0.5), -REACH)
        hedge = self.beyond - (REACH - 1.0)
        tall = torch.where(house >= hedge, storeys * STOREY + self._random(lot, 5), 3.0 + 2.0 * self._random(lot, 6))
        self.walls = torch.stack((torch.maximum(house, hedge), tall)).unsqueeze(0)
        self.inside = nn.functional.interpolate(self.walls[:, :1], scale_factor=TEXELS, mode="bilinear")[0, 0]
        style = (self._random(lot, 7) * STYLES).long()
        self.facade = torch.where(house >= hedge, style, STYLES).to(torch.uint8)

    def ground(self) -> Tensor:
        """Materials of the texels, a band of rows of cells at a time, which stays in the processor's cache."""
        rows = torch.arange(len(self.nearest)).split(16)
        return torch.cat([self._ground_band(band) for band in rows])

    def _ground_band(self, rows: Tensor) -> Tensor:
        """Materials ``[4R, 4W]`` of the texels in some rows of cells.

        All that is constant in a cell is ``[R, 1, W, 1]``, and what differs between its texels ``[R, 4, W, 4]``.
        """
        point = self.nearest[rows]
        columns = torch.arange(point.shape[1])
        heading = self.headings[point]
        cos, sin = (values[:, None, :, None] for values in (heading.cos(), heading.sin()))
        dx = (self.origin[0] + columns * CELL - self.points[point, 0])[:, None, :, None]
        dy = (self.origin[1] + rows[:, None] * CELL - self.points[point, 1])[:, None, :, None]
        inside = (torch.arange(TEXELS) + 0.5) / TEXELS * CELL - CELL / 2
        dx, dy = dx + inside, dy + inside.view(TEXELS, 1, 1)
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        beyond = torch.hypot((along.abs() - 0.25).clamp_(min=0), across) - self.half_width[point][:, None, :, None]
        far = (self.beyond[rows] >= REACH - 0.5)[:, None, :, None]
        beyond = torch.where(far, REACH, beyond)
        texture = [self._tiled(kind, rows, len(columns)) for kind in (_noise_tile, _fleck_tile, _slab_tile)]
        code = self._materials(point, along, across, beyond, texture, self.green[rows][:, None, :, None])
        code.masked_fill_(self.inside[rows[0] * TEXELS : (rows[-1] + 1) * TEXELS].view_as(code) > 0, Material.WALL)
        return code.reshape(len(rows) * TEXELS, -1)

    def _tiled(self, tile: Callable[[int], Tensor], rows: Tensor, columns: int) -> Tensor:
        """A square texture laid out over the texels of some rows of cells, ``[R, 4, W, 4]``."""
        texture = tile(self.seed)
        y = ((rows[:, None] * TEXELS + torch.arange(TEXELS)) % TILE).view(-1, 1)
        x = (torch.arange(columns * TEXELS) % TILE).view(1, -1)
        return texture[y, x].view(len(rows), TEXELS, columns, TEXELS)

    def _materials(
        self, point: Tensor, along: Tensor, across: Tensor, beyond: Tensor, texture: list[Tensor], green: Tensor
    ) -> Tensor:
        """Materials from the nearest lane's coordinates."""
        noise, fleck, slab = texture
        arc = self.arc[point][:, None, :, None] + along
        code = (Material.ASPHALT + noise * 6).to(torch.uint8)
        patch = self.patched[point][:, None, :, None] & ((across - 0.4).abs() < 1.1)
        code = torch.where(patch, (Material.PATCH + (fleck > 0.5)).to(torch.uint8), code)
        code = self._mark(code, point, arc, across, fleck > 0.06)
        code.masked_fill_(beyond > 0, Material.KERB)
        code = torch.where(beyond > 0.2, (Material.SIDEWALK + slab * 3).to(torch.uint8), code)
        code = torch.where(beyond > SIDEWALK - 1.2, (Material.GRASS + noise * 4).to(torch.uint8), code)
        yard = (beyond > SIDEWALK) & ~green
        return torch.where(yard, (Material.YARD + noise * 3).to(torch.uint8), code)

    def _mark(self, code: Tensor, point: Tensor, arc: Tensor, across: Tensor, whole: Tensor) -> Tensor:
        """Paint the lines of lanes outside junctions, worn here and there."""
        half = (self.half_width[point] - self.town.shoulder)[:, None, :, None]
        dash = (arc % 6.0) < 3.0
        for side, edge in zip(self.sides, (across + half, across - half), strict=True):
            kind = side[point][:, None, :, None]
            line = (edge.abs_() < 0.1) & whole
            code.masked_fill_(line & (kind == Material.EDGE_LINE), Material.EDGE_LINE)
            code.masked_fill_(line & (kind == Material.LANE_LINE) & dash, Material.LANE_LINE)
            centre = line & (kind == Material.CENTRE_LINE)
            code.masked_fill_(centre & dash, Material.CENTRE_LINE)
            code.masked_fill_(centre & ~dash, Material.CENTRE_GAP)
        lane = self.lane[point]
        end = torch.where((self.town.lane_to_junction.cpu() == 0)[lane], self.length[lane], torch.inf)
        before = end[:, None, :, None] - arc
        # A junction's lanes start where the lane before ends, and the ground there may be nearest to either.
        begins = (self.town.lane_manoeuvre.cpu() != SubTask.LANEFOLLOW)[lane][:, None, :, None] & (arc < 0)
        stops = (((before >= 0) & (before < 0.5)) | begins) & (across.abs() < half) & whole
        return code.masked_fill_(stops, Material.STOP_LINE)

    def _side_lines(self) -> list[Tensor]:
        """Two ``[P]``, the lines left and right of each centre-line point: by what lies across them."""
        street = (self.town.lane_manoeuvre.cpu() == SubTask.LANEFOLLOW)[self.lane]
        normal = torch.stack((-self.headings.sin(), self.headings.cos()), -1)
        lines = []
        for sign in (-1, 1):
            across = self.points + sign * (self.half_width - self.town.shoulder + 1.0).unsqueeze(-1) * normal
            there = ((across - self.origin) / CELL).round().long()
            neighbour = self.nearest[there[:, 1], there[:, 0]]
            facing = (self.headings - self.headings[neighbour]).cos()
            kind = torch.where(facing > 0, Material.LANE_LINE, Material.CENTRE_LINE)
            kind = torch.where(self.beyond[there[:, 1], there[:, 0]] > 0, Material.EDGE_LINE, kind)
            lines.append(torch.where(street, kind, Material.ASPHALT))
        return lines

    def props(self) -> tuple[Tensor, Tensor]:
        """Trees and lamp posts along the lanes, and which of them are near."""
        right = torch.stack((-self.headings.sin(), self.headings.cos()), -1)
        step = torch.arange(len(self.points))
        chance = self._random(step, 21)
        distance = SIDEWALK - 0.5 + 0.0 * chance
        lamp = (self.arc % 24.0 < 0.5) & (self.arc >= 12)
        tree = (self.arc % 8.0 < 0.5) & (chance < 0.2 + 0.6 * self._random(8)) & ~lamp
        chosen = (lamp | tree).nonzero().squeeze(-1)
        place = self.points[chosen] + (self.half_width + distance)[chosen].unsqueeze(-1) * right[chosen]
        size = self._random(chosen, 22)
        crowns = torch.stack((0.12 + 0.1 * size, 1.2 + size, 1.9 + 0.6 * size, 4.5 + 2.5 * size), -1)
        posts = torch.tensor([0.08, 0.35, 5.6, 5.9]).expand_as(crowns)
        props = torch.cat((place, torch.where(tree[chosen].unsqueeze(-1), crowns, posts)), -1)
        cell = ((place - self.origin) / CELL).round().long()
        size_ = torch.tensor(self.nearest.shape).flip(0)
        inside = ((cell >= 0) & (cell < size_)).all(-1)
        cell = cell.clamp(min=0).minimum(size_ - 1)
        # Another lane's verge may be this one's road.
        props = props[inside & (self.beyond[cell[:, 1], cell[:, 0]] > SIDEWALK - 1.0)]
        if len(props) < NEARBY:  # rows far away, which no camera sees
            props = torch.cat((props, torch.tensor([[1e6, 1e6, 0.1, 0.1, 1.0, 1.0]]).expand(NEARBY - len(props), -1)))
        extent = (torch.tensor(self.nearest.shape) * CELL / PROP_CELL).ceil().long().tolist()
        y, x = torch.meshgrid(*map(torch.arange, extent), indexing="ij")
        centres = (torch.stack((x, y), -1) + 0.5) * PROP_CELL + self.origin - CELL / 2
        _, nearby = cKDTree(props[:, :2].numpy()).query(centres.numpy(), k=NEARBY)
        return props, torch.from_numpy(np.ascontiguousarray(nearby))


@lru_cache(maxsize=8)
def _noise_tile(seed: int) -> Tensor:
    """Smooth noise in [0, 1) with features of 8, 2 and 0.125 m, ``[TILE, TILE]``."""
    total = torch.zeros(TILE, TILE)
    for size, weight in ((64, 0.5), (16, 0.3), (1, 0.2)):
        nodes = hash_uniform(seed, size, torch.arange((TILE // size) ** 2)).view(1, 1, TILE // size, -1)
        nodes = nn.functional.pad(nodes, (0, 1, 0, 1), mode="circular")
        smooth = nn.functional.interpolate(nodes, (TILE + 1, TILE + 1), mode="bilinear", align_corners=True)
        total += weight * smooth[0, 0, :TILE, :TILE]
    return total


@lru_cache(maxsize=8)
def _fleck_tile(seed: int) -> Tensor:
    """A number in [0, 1) for each texel, ``[TILE, TILE]``."""
    return hash_uniform(seed, torch.arange(TILE * TILE)).view(TILE, TILE)


@lru_cache(maxsize=8)
def _slab_tile(seed: int) -> Tensor:
    """A number in [0, 1) for each slab of 2 m, ``[TILE, TILE]``."""
    slabs = hash_uniform(seed, torch.arange((TILE // 16) ** 2)).view(TILE // 16, -1)
    return slabs.repeat_interleave(16, 0).repeat_interleave(16, 1)
