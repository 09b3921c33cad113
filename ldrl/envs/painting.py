"""The rgb view: the colour that each pixel of the dash camera shows."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ldrl.envs.appearance import CAR_COLOURS, CAR_PARTS, CODES, PARTS, SHADES, SKY_BANDS, Code, Look, band_of
from ldrl.envs.sight import (
    ABOVE,
    FOCAL,
    HORIZON,
    Cars,
    Mount,
    Obstacles,
    Props,
    Sight,
    choose,
    nearest_first,
    rows_within,
)
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
GROUND_FLOOR = 2
"""Of the parts of a facade: wall, window, ground floor."""
SUNNY, SHADY = 0.4, -0.2
"""Cosines of the angle to the sun above which a facade has full light, and below which it has none."""


class Facades(NamedTuple):
    """What the columns of pixels see of walls.

    Attributes:
        depth: ``[N, 200]``, m; infinite where there is no wall.
        rows: ``[N, 200]`` int16, rows above the horizon up to the top of the wall.
        code: ``[N, 200]`` int16, colour of its wall part.
        window: ``[N, 200]`` int16, 1 where the column passes through windows, else 0.
    """

    depth: Tensor
    rows: Tensor
    code: Tensor
    window: Tensor


def paint(sight: Sight, scenery: Scenery, mount: Mount, look: Look, traffic: Tensor | None, out: Tensor) -> None:
    """Draw rgb images.

    Args:
        sight: the lines of sight.
        scenery: what there is to see.
        mount: N cameras.
        look: of each camera, or of one for all.
        traffic: other cars, ``[N, P, 4]``.
        out: ``[N, 3, 88, 200]`` uint8, where to draw.
    """
    ground, first = sight.ground(scenery, mount)
    props = sight.props(scenery, mount, PROPS_IN_SIGHT)
    obstacles = sight.obstacles(scenery, props, first)
    facades = _facades(sight, scenery, mount, first, look.sun)
    post = scenery.props[props.prop, 3].gather(1, obstacles.stem.clamp(min=0)) < LARGEST_POST
    stem = torch.where(post, Code.POST, Code.TRUNK).to(torch.int16) + CODES * band_of(obstacles.depth)
    upright = torch.where(obstacles.stem >= 0, stem, facades.code + GROUND_FLOOR).unsqueeze(1)
    lower = ground + (CODES * band_of(sight.reach)).unsqueeze(-1)
    lower = choose(sight.within(obstacles.rows), upright, lower)
    if traffic is not None:
        lower = _with_cars(sight, sight.cars(mount, traffic), obstacles, lower)
    upper = _with_crowns(sight, scenery, props, facades, _sky_and_walls(sight, scenery, mount, facades))
    codes = torch.empty((len(ground), *out.shape[2:]), dtype=torch.int32, device=out.device)
    codes[:, :HORIZON], codes[:, HORIZON:] = upper.flip(1), lower
    if len(look.sun) > 1:
        codes += torch.arange(0, look.colours.numel(), look.colours.shape[1], device=out.device).int().view(-1, 1, 1)
    colours = look.colours.view(-1).index_select(0, codes.view(-1)).view_as(codes)
    out.copy_(colours.view(torch.uint8).view(*codes.shape, 4)[..., :3].movedim(-1, 1))


def _facades(sight: Sight, scenery: Scenery, mount: Mount, first: Tensor, sun: Tensor) -> Facades:
    """The first wall of each column: where exactly it stands between two depths, and how it is lit."""
    inside, height = scenery.walls.flatten(2)[0]
    size_y, size_x = scenery.facade.shape
    look_x, look_y = mount.cos - sight.slope * mount.sin, mount.sin + sight.slope * mount.cos

    def cell(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y = mount.xy[:, :1] + depth * look_x, mount.xy[:, 1:] + depth * look_y
        column = ((x - scenery.corner[0]) / CELL).long().clamp(1, size_x - 2)
        row = ((y - scenery.corner[1]) / CELL).long().clamp(1, size_y - 2)
        return x, y, row * size_x + column

    beyond = sight.depths[first]
    there = beyond.isfinite()
    beyond = torch.where(there, beyond, 1.0)
    before = sight.depths[(first - 1).clamp(min=0)].minimum(beyond)
    outside, within = inside[cell(before)[2]], inside[cell(beyond)[2]]
    depth = torch.lerp(before, beyond, (outside / (outside - within)).nan_to_num(0).clamp(0, 1))
    x, y, here = cell(depth + CELL)
    normal_x, normal_y = inside[here - 1] - inside[here + 1], inside[here - size_x] - inside[here + size_x]
    facing = (normal_x * sun[:, :1] + normal_y * sun[:, 1:]) / (2 * CELL)
    style = scenery.facade.view(-1)[here].to(torch.int16)
    shade = (facing > SHADY).to(torch.int16) + (facing > SUNNY).to(torch.int16)
    along = torch.where(normal_x.abs() > normal_y.abs(), y, x) / WINDOW_SPACING
    window = ((along - along.floor() - 0.5).abs() < 0.22) & (style < STYLES)
    rows = rows_within((height[here] - ABOVE) / depth) * there
    code = (style * SHADES + shade) * PARTS + Code.FACADE + CODES * band_of(depth)
    return Facades(torch.where(there, depth, torch.inf), rows, code, window.to(torch.int16))


def _sky_and_walls(sight: Sight, scenery: Scenery, mount: Mount, facades: Facades) -> Tensor:
    """Codes of the rows above the horizon, from the horizon up, ``[N, 44, 200]`` int16, without props."""
    wall = facades.code.unsqueeze(1)
    sky = (Code.SKY + sight.row * SKY_BANDS // HORIZON).expand(-1, wall.shape[-1])
    skyline, behind = _skyline(sight, scenery, mount)
    codes = choose(sight.within(skyline), behind.unsqueeze(1), sky)
    # How many storeys up a pixel looks, in 1024ths.
    per_row = (facades.depth * (1024 / FOCAL / STOREY)).clamp(max=700).to(torch.int16).unsqueeze(1)
    storeys = (sight.row * per_row).add_(int(1024 * (ABOVE / STOREY + 0.2)))
    window = storeys.bitwise_right_shift_(9).bitwise_and_(facades.window.unsqueeze(1))  # every other half storey
    codes = choose(sight.within(facades.rows), window.add_(wall), codes)
    ground_floor = torch.minimum(rows_within((STOREY - ABOVE) / facades.depth), facades.rows)
    return choose(sight.within(ground_floor), wall + GROUND_FLOOR, codes)


def _skyline(sight: Sight, scenery: Scenery, mount: Mount) -> tuple[Tensor, Tensor]:
    """What towers over the first walls: rows, and the code of its colour, ``[N, 200]``."""
    size_y, size_x = scenery.facade.shape
    inside, height = scenery.walls.flatten(2)[0]
    x, y = mount.map(sight.far_rays, scenery.corner, 1 / CELL)
    cell = y.clamp_(0, size_y - 1).int().mul_(size_x).add_(x.clamp_(0, size_x - 1).int()).view(-1)
    tall = torch.where(inside.index_select(0, cell) > 0, height.index_select(0, cell), 0.0)
    depths = sight.far_depths
    rows = rows_within((tall.view(len(mount.xy), len(depths), -1) - ABOVE) / depths.unsqueeze(-1))
    # Rows and, in the lowest bits, which depth: the greatest of such numbers has both.
    order = torch.arange(31, 31 - len(depths), -1, dtype=torch.int16, device=depths.device).unsqueeze(-1)
    greatest = (rows * 32 + order).amax(1)
    at = 31 - (greatest & 31).long()
    style = scenery.facade.view(-1)[cell.view_as(rows).gather(1, at.unsqueeze(1)).squeeze(1)]
    return greatest >> 5, (style.to(torch.int16) * SHADES + 1) * PARTS + Code.FACADE + CODES * band_of(depths)[at]


def _with_crowns(sight: Sight, scenery: Scenery, props: Props, facades: Facades, codes: Tensor) -> Tensor:
    """The codes of the rows above the horizon with trees and posts in front."""
    shape = scenery.props[props.prop, 2:].unsqueeze(-1)
    seen = (facades.depth.unsqueeze(1) > props.ahead) & (props.aside.abs() < shape[:, :, 1])
    which, found = nearest_first(seen, CROWNS)
    depth = torch.where(found, props.ahead.squeeze(-1).gather(1, which.flatten(1)).view_as(which), torch.inf)
    shape = shape.expand(-1, -1, -1, depth.shape[-1]).gather(1, which.unsqueeze(2).expand(-1, -1, 4, -1))
    stem, radius, bottom, top = shape.unbind(2)
    aside = props.aside.gather(1, which).abs()
    half = (top - bottom) / 2 * (1 - (aside / radius).square()).clamp(min=0).sqrt()
    middle = (top + bottom) / 2 - ABOVE
    low, centre, high = (rows_within((middle + side * half) / depth) for side in (-1, 0, 1))
    post, band = radius < LARGEST_POST, CODES * band_of(depth)
    upper = (torch.where(post, Code.LAMP, Code.FOLIAGE + 1).to(torch.int16) + band).unsqueeze(2)
    lower = (torch.where(post, Code.LAMP, Code.FOLIAGE).to(torch.int16) + band).unsqueeze(2)
    stem_code = (torch.where(post, Code.POST, Code.TRUNK).to(torch.int16) + band).unsqueeze(2)
    stem_rows = low * (aside < stem)
    for k in reversed(range(CROWNS)):  # the nearest last
        crown = choose(sight.within(centre[:, k]), lower[:, k], upper[:, k])
        codes = choose(sight.within(high[:, k]) & ~sight.within(low[:, k]), crown, codes)
        codes = choose(sight.within(stem_rows[:, k]), stem_code[:, k], codes)
    return codes


def _with_cars(sight: Sight, cars: Cars, obstacles: Obstacles, codes: Tensor) -> Tensor:
    """The codes of the rows below the horizon with cars in front."""
    covered = sight.covers(cars, obstacles)
    body = (Code.CAR + CAR_PARTS * (cars.car % CAR_COLOURS)).to(torch.int16) + CODES * band_of(cars.near)
    # From the top: roof, windows, body, and tyres down to the road.
    edges = [rows_within((ABOVE - height) / cars.near) for height in (1.4, 0.9, 0.3)]
    for k in reversed(range(covered.shape[1])):  # the nearest last
        part = len(edges) + sum(sight.within(edge[:, k]) for edge in edges)
        codes = choose(covered[:, k], body[:, k, None] + part, codes)
    return codes
