"""The drivable surface of a town as rasters."""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample

__all__ = ["CELL", "LANE_SPACING", "MARGIN", "Surface", "rasterise", "sample"]

CELL = 0.5
"""Edge of a raster cell, m."""
LANE_SPACING = 0.5
"""Largest distance between two samples of a lane's centre line, m."""
MARGIN = 8.0
"""How far a town's rasters reach beyond the edge of the road, and the largest distance they tell, m."""


class Surface(NamedTuple):
    """Rasters over a town; cell ``[..., i, j]`` is centred at ``origin + CELL * (j, i)``.

    Attributes:
        origin: ``[2]`` float32, x and y of the first cell's centre, m.
        road_distance: ``[1, 1, H, W]`` float32, signed distance to the edge of the road, negative on it, at most
            the margin, m.
        nearest_point: ``[H, W]`` int64, index of the nearest centre-line point; 0 where none is in reach.
    """

    origin: Tensor
    road_distance: Tensor
    nearest_point: Tensor


def rasterise(
    points: Tensor, headings: Tensor, half_width: Tensor | float, spacing: float, margin: float = MARGIN
) -> Surface:
    """Rasterise the union of bands around centre lines.

    Args:
        points: ``[P, 2]`` float32, samples of all centre lines, m.
        headings: ``[P]`` float32, directions of the centre lines there, rad.
        half_width: half the width of the band, a number or ``[P]`` float32, m.
        spacing: largest distance between neighbouring samples, m.
        margin: how far the rasters reach beyond the bands, m.

    Returns:
        The rasters. Each cell looks at the straight piece through the sample next to it, so the distance is exact to
        the curvature within half a spacing.
    """
    half_width = torch.as_tensor(half_width, dtype=torch.float32).expand(len(points))
    border = float(half_width.max()) + margin
    origin = points.amin(0) - border
    width, height = ((points.amax(0) + border - origin) / CELL).ceil().int().add(1).tolist()
    grid = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    cells = torch.stack(grid[::-1], -1).view(-1, 2) * CELL + origin
    _, found = cKDTree(points.numpy()).query(cells.numpy(), distance_upper_bound=border + spacing)
    nearest = torch.from_numpy(found)
    out_of_reach = nearest == len(points)
    nearest[out_of_reach] = 0
    offset, heading = cells - points[nearest], headings[nearest]
    tangent = torch.stack((heading.cos(), heading.sin()), -1)
    along = (offset * tangent).sum(-1, keepdim=True).clamp(-spacing / 2, spacing / 2)
    distance = (offset - along * tangent).norm(dim=-1) - half_width[nearest]
    distance = distance.masked_fill(out_of_reach, margin).clamp(max=margin)
    return Surface(origin, distance.view(1, 1, height, width), nearest.view(height, width))


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
