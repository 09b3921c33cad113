"""The drivable surface of a town as rasters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample

__all__ = ["CELL", "LANE_SPACING", "MARGIN", "Surface", "raster_size", "rasterise", "sample"]

CELL = 0.5
"""Edge of a raster cell, m."""
LANE_SPACING = 0.5
"""Largest distance between two samples of a lane's centre line, m."""
MARGIN = 8.0
"""How far a town's rasters reach beyond the edge of the road, and the largest distance they tell, m."""
MAX_CELLS = 16_000_000
"""Largest raster: 2 by 2 km."""
CELLS_AT_ONCE = 1 << 20
"""Cells computed together, which bounds the memory needed."""
WIDTH_STEP = 0.25
"""Half widths that differ less count as the same, m."""


class Surface(NamedTuple):
    """Rasters over a town; cell ``[..., i, j]`` is centred at ``origin + CELL * (j, i)``.

    Attributes:
        origin: ``[2]`` float32, x and y of the first cell's centre, m.
        road_distance: ``[1, 1, H, W]`` float32, signed distance to the edge of the road, negative on it, at most
            the margin, m.
        nearest_point: ``[H, W]`` int64, index of the centre-line point in whose band the cell lies deepest; 0 where
            none is in reach.
    """

    origin: Tensor
    road_distance: Tensor
    nearest_point: Tensor


def raster_size(extent: Sequence[float]) -> tuple[int, int]:
    """Columns and rows of the rasters over an area.

    Args:
        extent: from west to east and from north to south, m.

    Raises:
        ValueError: there would be more than 16 million cells.
    """
    width, height = (math.ceil(size / CELL) + 1 for size in extent)
    if width * height > MAX_CELLS:
        area = f"{width * CELL / 1000:.1f} by {height * CELL / 1000:.1f} km"
        raise ValueError(f"the map covers {area}; cut it to an area of {MAX_CELLS * CELL**2 / 1e6:g} square kilometres")
    return width, height


def rasterise(
    points: Tensor, headings: Tensor, half_width: Tensor | float, spacing: float, margin: float = MARGIN
) -> Surface:
    """Rasterise the union of bands around centre lines.

    Args:
        points: ``[P, 2]`` float32, samples of all centre lines, m.
        headings: ``[P]`` float32, directions of the centre lines there, rad.
        half_width: half the width of the bands, a number or ``[P]`` float32, m.
        spacing: largest distance between neighbouring samples, m.
        margin: how far the rasters reach beyond the bands, m.

    Returns:
        The rasters. Each cell looks at the straight piece through the sample next to it, so the distance is exact to
        the curvature within half a spacing.

    Raises:
        ValueError: the rasters would be too large.
    """
    half_width = torch.as_tensor(half_width, dtype=torch.float32).expand(len(points))
    border = float(half_width.max()) + margin
    origin = points.amin(0) - border
    width, height = raster_size((points.amax(0) + border - origin).tolist())
    # Of bands of about one width the nearest centre line is the deepest, so each width is asked for its nearest.
    widths = (half_width / WIDTH_STEP).round()
    groups = [(widths == width).nonzero().squeeze(-1) for width in widths.unique()]
    trees = [(group, cKDTree(points[group].numpy())) for group in groups]
    distance, nearest = torch.empty(height * width), torch.zeros(height * width, dtype=torch.long)
    for cells in torch.arange(height * width).split(CELLS_AT_ONCE):
        position = torch.stack((cells % width, cells // width), -1) * CELL + origin
        candidates = torch.stack([_nearest(*tree, position, border + spacing, len(points)) for tree in trees], -1)
        out_of_reach = candidates == len(points)
        candidates[out_of_reach] = 0
        offset, heading = position.unsqueeze(1) - points[candidates], headings[candidates]
        tangent = torch.stack((heading.cos(), heading.sin()), -1)
        along = (offset * tangent).sum(-1, keepdim=True).clamp(-spacing / 2, spacing / 2)
        beyond = (offset - along * tangent).norm(dim=-1) - half_width[candidates]
        beyond, deepest = beyond.masked_fill(out_of_reach, margin).clamp(max=margin).min(1, keepdim=True)
        distance[cells], nearest[cells] = beyond.squeeze(1), candidates.gather(1, deepest).squeeze(1)
    return Surface(origin, distance.view(1, 1, height, width), nearest.view(height, width))


def _nearest(group: Tensor, tree: cKDTree, position: Tensor, reach: float, none: int) -> Tensor:
    """Index of the group's point nearest to each position, ``none`` where there is none within reach."""
    _, found = tree.query(position.numpy(), distance_upper_bound=reach)
    return torch.cat((group, torch.tensor([none])))[torch.from_numpy(found)]


def sample(raster: Tensor, origin: Tensor, positions: Tensor, mode: str = "bilinear") -> Tensor:
    """Read a raster at positions; outside it, its border value.

    Args:
        raster: ``[1, C, H, W]`` float32.
        origin: ``[2]`` float32, see :class:`Surface`.
        positions: ``[*B, 2]`` float32, m.
        mode: ``"bilinear"`` or ``"nearest"``.

    Returns:
        ``[*B, C]`` float32.
    """
    size = torch.tensor(raster.shape[:-3:-1], device=raster.device)
    grid = (positions - origin) * (2 / (CELL * (size - 1))) - 1
    values = grid_sample(raster, grid.view(1, 1, -1, 2), mode, padding_mode="border", align_corners=True)
    return values.view(raster.shape[1], -1).t().reshape(*positions.shape[:-1], -1)
