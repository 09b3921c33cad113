"""What the ground of a town is made of, texel by texel."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ldrl.subtasks import SubTask
from ldrl.towns.noise import TILE, flecks, hash_uniform, slabs, smooth_noise
from ldrl.towns.surface import CELL

if TYPE_CHECKING:
    from ldrl.towns.town import Town

__all__ = ["SIDEWALK", "TEXELS", "Ground", "Material", "stations"]

TEXELS = 4
"""Texels of the ground along the edge of a raster cell: they measure 12.5 cm."""
SIDEWALK = 4.0
"""Width of the sidewalk and its verge, m."""
KERB, VERGE = 0.2, 1.2
"""Parts of it, next to the road and next to the houses, m."""
LINE = 0.1
"""Half the width of a painted line, m."""
DASH = 3.0
"""Length of a dash and of the gap after it, m."""
STOP_LINE = 0.5
"""How far before a junction's entry the stop line begins, m."""


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


class Ground:
    """The ground of a town, from the coordinates of the nearest lane.

    Args:
        town: the town.
        seed: of patches and shades.
        origin, nearest, beyond: of the raster of cells, see :class:`~ldrl.towns.surface.Surface`; ``nearest`` and
            ``beyond``, the distance beyond the edge of the road, are ``[H, W]``.
    """

    def __init__(self, town: Town, seed: int, origin: Tensor, nearest: Tensor, beyond: Tensor) -> None:
        self.seed, self.origin, self.nearest, self.beyond = seed, origin, nearest, beyond
        self.points, self.headings, self.half_width = town.points.cpu(), town.headings.cpu(), town.half_width.cpu()
        self.lane, self.arc = stations(town)
        self.street = (town.lane_manoeuvre.cpu() == SubTask.LANEFOLLOW)[self.lane]
        leads_into_junction = (town.lane_to_junction.cpu() == 0)[self.lane]
        self.end = torch.where(leads_into_junction, town.lane_length.cpu()[self.lane], torch.inf)
        self.lane_half = self.half_width - town.shoulder
        self.patched = hash_uniform(seed, self.lane, (self.arc / 5).long(), 11) < 0.08
        self.sides = self._side_lines()

    def materials(self, green: Tensor, inside: Tensor) -> Tensor:
        """Materials of the texels.

        Args:
            green: ``[H, W]`` bool, cells of lots that are lawn.
            inside: ``[H, W]`` float32, positive where a wall stands.

        Returns:
            ``[4H, 4W]`` uint8.
        """
        # A band of rows of cells at a time stays in the processor's cache.
        bands = torch.arange(len(self.nearest)).split(16)
        return torch.cat([self._band(rows, green[rows][:, None, :, None], inside) for rows in bands])

    def _band(self, rows: Tensor, green: Tensor, inside: Tensor) -> Tensor:
        """Materials ``[4R, 4W]`` of the texels in some rows of cells.

        All that is constant in a cell is ``[R, 1, W, 1]``, and what differs between its texels ``[R, 4, W, 4]``.
        """
        point = self.nearest[rows]
        columns = torch.arange(point.shape[1])
        heading = self.headings[point]
        cos, sin = (values[:, None, :, None] for values in (heading.cos(), heading.sin()))
        dx = (self.origin[0] + columns * CELL - self.points[point, 0])[:, None, :, None]
        dy = (self.origin[1] + rows[:, None] * CELL - self.points[point, 1])[:, None, :, None]
        texel = (torch.arange(TEXELS) + 0.5) / TEXELS * CELL - CELL / 2
        dx, dy = dx + texel, dy + texel.view(TEXELS, 1, 1)
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        beyond = torch.hypot((along.abs() - 0.25).clamp_(min=0), across) - self.half_width[point][:, None, :, None]
        # Cells out of reach know no lane: what they call the nearest may be anywhere.
        beyond = torch.maximum(beyond, (self.beyond[rows] - CELL)[:, None, :, None])
        texture = [self._tiled(kind, rows, len(columns)) for kind in (smooth_noise, flecks, slabs)]
        code = self._codes(point, along, across, beyond, texture, green).reshape(len(rows) * TEXELS, -1)
        return code.masked_fill_(self._upsample(inside, rows) > 0, Material.WALL)

    def _upsample(self, values: Tensor, rows: Tensor) -> Tensor:
        """Values of texels between those of cells, ``[4R, 4W]``, for some rows of cells."""
        around = torch.arange(int(rows[0]) - 1, int(rows[-1]) + 2).clamp(0, len(values) - 1)
        fine = interpolate(values[around][None, None], scale_factor=TEXELS, mode="bilinear")
        return fine[0, 0, TEXELS:-TEXELS]

    def _tiled(self, tile: Callable[[int], Tensor], rows: Tensor, columns: int) -> Tensor:
        """A square texture laid out over the texels of some rows of cells, ``[R, 4, W, 4]``."""
        texture = tile(self.seed)
        y = ((rows[:, None] * TEXELS + torch.arange(TEXELS)) % TILE).view(-1, 1)
        x = (torch.arange(columns * TEXELS) % TILE).view(1, -1)
        return texture[y, x].view(len(rows), TEXELS, columns, TEXELS)

    def _codes(
        self, point: Tensor, along: Tensor, across: Tensor, beyond: Tensor, texture: list[Tensor], green: Tensor
    ) -> Tensor:
        """Materials from the nearest lane's coordinates, m."""
        noise, fleck, slab = texture
        code = torch.where(beyond > KERB, (Material.SIDEWALK + slab * 3).to(torch.uint8), int(Material.KERB))
        code = torch.where(beyond > SIDEWALK - VERGE, (Material.GRASS + noise * 4).to(torch.uint8), code)
        yard = (beyond > SIDEWALK) & ~green
        code = torch.where(yard, (Material.YARD + noise * 3).to(torch.uint8), code)
        # Most cells have no road; those that have, N of them, are worked out by themselves.
        row, column = (beyond <= 0).any(3).any(1).nonzero().unbind(-1)
        lane = [values[row, :, column] for values in (along, across, noise, fleck)]
        road = self._road(point[row, column].view(-1, 1, 1), *lane)
        code[row, :, column] = torch.where(beyond[row, :, column] > 0, code[row, :, column], road)
        return code

    def _road(self, point: Tensor, along: Tensor, across: Tensor, noise: Tensor, fleck: Tensor) -> Tensor:
        """Materials of the road in some cells, ``[N, 4, 4]``; ``point`` is ``[N, 1, 1]``."""
        arc = self.arc[point] + along
        code = (Material.ASPHALT + noise * 6).to(torch.uint8)
        patch = self.patched[point] & ((across - 0.4).abs() < 1.1)
        code = torch.where(patch, (Material.PATCH + (fleck > 0.5)).to(torch.uint8), code)
        return self._mark(code, point, arc, across, fleck > 0.06)

    def _mark(self, code: Tensor, point: Tensor, arc: Tensor, across: Tensor, whole: Tensor) -> Tensor:
        """Paint the lines of lanes outside junctions, worn here and there."""
        half = self.lane_half[point]
        dash = (arc % (2 * DASH)) < DASH
        for side, edge in zip(self.sides, (across + half, across - half), strict=True):
            kind = side[point]
            line = (edge.abs_() < LINE) & whole
            code.masked_fill_(line & (kind == Material.EDGE_LINE), Material.EDGE_LINE)
            code.masked_fill_(line & (kind == Material.LANE_LINE) & dash, Material.LANE_LINE)
            centre = line & (kind == Material.CENTRE_LINE)
            code.masked_fill_(centre & dash, Material.CENTRE_LINE)
            code.masked_fill_(centre & ~dash, Material.CENTRE_GAP)
        before = self.end[point] - arc
        # A junction's lanes start where the lane before ends, and the ground there may be nearest to either.
        begins = ~self.street[point] & (arc < 0)
        stops = (((before >= 0) & (before < STOP_LINE)) | begins) & (across.abs() < half) & whole
        return code.masked_fill_(stops, Material.STOP_LINE)

    def _side_lines(self) -> list[Tensor]:
        """Two ``[P]``, the lines left and right of each centre-line point: by what lies across them."""
        normal = torch.stack((-self.headings.sin(), self.headings.cos()), -1)
        lines = []
        for sign in (-1, 1):
            across = self.points + sign * (self.lane_half + 1.0).unsqueeze(-1) * normal
            there = ((across - self.origin) / CELL).round().long()
            neighbour = self.nearest[there[:, 1], there[:, 0]]
            facing = (self.headings - self.headings[neighbour]).cos()
            kind = torch.where(facing > 0, Material.LANE_LINE, Material.CENTRE_LINE)
            kind = torch.where(self.beyond[there[:, 1], there[:, 0]] > 0, Material.EDGE_LINE, kind)
            lines.append(torch.where(self.street, kind, Material.ASPHALT))
        return lines


def stations(town: Town) -> tuple[Tensor, Tensor]:
    """Lane, ``[P]`` int64, and arc length from its start, ``[P]`` float32 (m), of each of the town's points."""
    first, index = town.lane_first.cpu(), torch.arange(len(town.points))
    lane = torch.searchsorted(first, index, right=True) - 1
    return lane, (index - first[lane]) * town.lane_spacing.cpu()[lane]
