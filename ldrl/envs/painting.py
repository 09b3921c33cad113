"""The rgb view: the colour that each pixel of the dash camera shows."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ldrl.envs.appearance import CAR_COLOURS, CAR_PARTS, CODES, PARTS, SHADES, SKY_BANDS, Code, Look, band_of
from ldrl.envs.sight import ABOVE, Cars, Mount, Props, Sight
from ldrl.towns.scenery import STOREY, STYLES, Scenery
from ldrl.towns.surface import CELL

__all__ = ["paint"]

PROPS_IN_SIGHT = 16
"""Trees and posts drawn at most: the nearest ahead."""
CROWNS = 2
"""Crowns drawn one behind the other in a column of pixels."""
LARGEST_POST = 0.5
"""A crown of a smaller radius is a lamp on a post, m."""
WINDOW_SPACING = 2.6
"""Between the windows of a storey, m."""
SUNNY, SHADY = 0.4, -0.2
"""Cosines of the angle to the sun above which a facade has full light, and below which it has none."""


class Facades(NamedTuple):
    """What the columns of pixels see of walls.

    Attributes:
        depth: ``[N, 200]``, m; meaningless where ``top`` is -1.
        top: ``[N, 200]``, where the wall ends, m up per m ahead; -1 where there is no wall.
        code: ``[N, 200]`` int16, colour of its wall part.
        window: ``[N, 200]`` bool, whether the column passes through windows.
    """

    depth: Tensor
    top: Tensor
    code: Tensor
    window: Tensor


def paint(sight: Sight, scenery: Scenery, mount: Mount, look: Look, traffic: Tensor | None = None) -> Tensor:
    """Draw rgb images.

    Args:
        sight: the lines of sight.
        scenery: what there is to see.
        mount: N cameras.
        look: of each camera, or of one for all.
        traffic: other cars, ``[N, P, 4]``.

    Returns:
        ``[N, 3, 88, 200]`` uint8.
    """
    ground, first = sight.ground(scenery, mount)
    props = sight.props(scenery, mount, PROPS_IN_SIGHT)
    nearest, stem = sight.obstacle(scenery, props, first)
    post = scenery.props[props.index, 3].gather(1, stem.clamp(min=0)) < LARGEST_POST
    facades = _facades(sight, scenery, mount, first, look.sun)
    lower = ground + (CODES * band_of(sight.reach)).unsqueeze(-1)
    stem_code = torch.where(post, Code.POST, Code.TRUNK) + CODES * band_of(nearest)
    upright = torch.where(stem >= 0, stem_code, facades.code + 2).to(torch.int16)
    lower = torch.where(sight.sees_ground(nearest), lower, upright.unsqueeze(1))
    if traffic is not None:
        lower = _with_cars(sight, sight.cars(mount, traffic), nearest, lower)
    upper = _with_crowns(sight, scenery, props, facades, _sky_and_walls(sight, scenery, mount, facades))
    codes = torch.cat((upper.flip(1), lower), 1).int()
    if len(look.colours) > 1:
        codes += torch.arange(0, look.colours.numel(), look.colours.shape[1], device=codes.device).int().view(-1, 1, 1)
    colours = look.colours.view(-1).index_select(0, codes.view(-1)).view_as(codes)
    return torch.stack((colours.to(torch.uint8), (colours >> 8).to(torch.uint8), (colours >> 16).to(torch.uint8)), 1)


def _facades(sight: Sight, scenery: Scenery, mount: Mount, first: Tensor, sun: Tensor) -> Facades:
    """The first wall of each column: where exactly it stands between two depths, and how it is lit."""
    inside, height = scenery.walls.flatten(2)[0]
    rows, columns = scenery.facade.shape
    look_x, look_y = mount.cos - sight.slope * mount.sin, mount.sin + sight.slope * mount.cos

    def cell(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y = mount.xy[:, :1] + depth * look_x, mount.xy[:, 1:] + depth * look_y
        column = ((x - scenery.corner[0]) / CELL).long().clamp(1, columns - 2)
        row = ((y - scenery.corner[1]) / CELL).long().clamp(1, rows - 2)
        return x, y, row * columns + column

    beyond = sight.depths[first]
    there = beyond.isfinite()
    beyond = torch.where(there, beyond, 1.0)
    before = sight.depths[(first - 1).clamp(min=0)].minimum(beyond)
    outside, within = inside[cell(before)[2]], inside[cell(beyond)[2]]
    depth = torch.lerp(before, beyond, (outside / (outside - within)).nan_to_num(0).clamp(0, 1))
    x, y, here = cell(depth + CELL)
    normal_x, normal_y = inside[here - 1] - inside[here + 1], inside[here - columns] - inside[here + columns]
    facing = (normal_x * sun[:, :1] + normal_y * sun[:, 1:]) / (2 * CELL)
    style = scenery.facade.view(-1)[here].to(torch.int16)
    shade = (facing > SHADY).to(torch.int16) + (facing > SUNNY)
    along = torch.where(normal_x.abs() > normal_y.abs(), y, x) / WINDOW_SPACING
    window = ((along - along.floor() - 0.5).abs() < 0.22) & (style < STYLES)
    top = torch.where(there, (height[here] - ABOVE) / depth, -1.0)
    return Facades(depth, top, Code.FACADE + (style * SHADES + shade) * PARTS + CODES * band_of(depth), window)


def _sky_and_walls(sight: Sight, scenery: Scenery, mount: Mount, facades: Facades) -> Tensor:
    """Codes of the rows above the horizon, from the horizon up, ``[N, 44, 200]`` int16, without props."""
    up = sight.down.unsqueeze(-1)
    sky = Code.SKY + torch.linspace(0, SKY_BANDS - 0.01, len(up), device=up.device).to(torch.int16).unsqueeze(-1)
    skyline, behind = _skyline(sight, scenery, mount)
    codes = torch.where(up < skyline.unsqueeze(1), behind.unsqueeze(1), sky)
    storeys = (ABOVE + up * facades.depth.unsqueeze(1)) / STOREY
    part = (((storeys - storeys.floor() - 0.55).abs() < 0.25) & facades.window.unsqueeze(1)).to(torch.int16)
    part = torch.where(storeys < 1, 2, part)
    return torch.where(up < facades.top.unsqueeze(1), facades.code.unsqueeze(1) + part, codes)


def _skyline(sight: Sight, scenery: Scenery, mount: Mount) -> tuple[Tensor, Tensor]:
    """What towers over the first walls: its slope and the code of its colour, ``[N, 200]``."""
    rows, columns = scenery.facade.shape
    inside, height = scenery.walls.flatten(2)[0]
    x, y = mount.map(sight.far_rays, scenery.corner, 1 / CELL)
    cell = y.clamp_(0, rows - 1).int().mul_(columns).add_(x.clamp_(0, columns - 1).int()).view(-1)
    tall = torch.where(inside.index_select(0, cell) > 0, height.index_select(0, cell), 0.0)
    depths = sight.far_depths.unsqueeze(-1)
    slope, at = ((tall.view(len(mount.xy), len(depths), -1) - ABOVE) / depths).max(1)
    style = scenery.facade.view(-1)[cell.view(len(slope), len(depths), -1).gather(1, at.unsqueeze(1)).squeeze(1)]
    return slope, Code.FACADE + (style.to(torch.int16) * SHADES + 1) * PARTS + CODES * band_of(sight.far_depths)[at]


def _with_crowns(sight: Sight, scenery: Scenery, props: Props, facades: Facades, codes: Tensor) -> Tensor:
    """The codes of the rows above the horizon with trees and posts in front."""
    shape = scenery.props[props.index, 2:].unsqueeze(-1)
    hidden = (facades.top >= 0).unsqueeze(1) & (facades.depth.unsqueeze(1) < props.ahead)
    hidden |= props.aside.abs() > shape[:, :, 1]
    depth, which = props.ahead.expand_as(hidden).masked_fill(hidden, torch.inf).topk(CROWNS, 1, largest=False)
    shape = shape.expand(-1, -1, -1, depth.shape[-1]).gather(1, which.unsqueeze(2).expand(-1, -1, 4, -1))
    stem, radius, bottom, top = shape.unbind(2)
    aside = props.aside.gather(1, which).abs()
    half = (top - bottom) / 2 * (1 - (aside / radius).square()).clamp(min=0).sqrt()
    middle = (top + bottom) / 2 - ABOVE
    low, high = (middle - half) / depth, (middle + half) / depth
    post = radius < LARGEST_POST
    band = CODES * band_of(depth)
    crown = torch.where(post, Code.LAMP, Code.FOLIAGE) + band
    stem_code = torch.where(post, Code.POST, Code.TRUNK) + band
    brighter = (~post).to(torch.int16)
    low_of_stem = torch.where(aside < stem, low, 0)
    up = sight.down.unsqueeze(-1)
    for k in reversed(range(CROWNS)):  # the nearest last
        inside = (up > low[:, k, None]) & (up < high[:, k, None])
        lit = crown[:, k, None] + (up > (middle / depth)[:, k, None]) * brighter[:, k, None]
        codes = torch.where(up < low_of_stem[:, k, None], stem_code[:, k, None], torch.where(inside, lit, codes))
    return codes


def _with_cars(sight: Sight, cars: Cars, nearest: Tensor, codes: Tensor) -> Tensor:
    """The codes of the rows below the horizon with cars in front."""
    covered = sight.covers(cars, nearest)
    down = sight.down.unsqueeze(-1)
    for k in reversed(range(covered.shape[1])):  # the nearest last
        near = cars.near[:, k, None]
        height = ABOVE - down * near
        part = torch.where((height - 1.15).abs() < 0.25, 2, torch.where(height < 0.3, 3, (height < 0.95).short()))
        colour = Code.CAR + CAR_PARTS * (cars.car[:, k, None] % CAR_COLOURS) + CODES * band_of(near)
        codes = torch.where(covered[:, k], (colour + part).to(codes.dtype), codes)
    return codes
