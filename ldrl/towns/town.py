"""A town as tensors: its lanes, what follows them, and the drivable surface."""

from __future__ import annotations

import math

import numpy as np
import torch
from highway_env.road.road import RoadNetwork
from torch import Tensor, nn
from torch.nn.functional import embedding

from ldrl.subtasks import SubTask
from ldrl.towns import surface
from ldrl.towns.layout import load_layout

__all__ = ["ROUTE_LANES", "Town"]

LANE_SPACING = 0.5
"""Largest distance between two samples of a lane's centre line, m."""
SHOULDER = 0.3
"""Drivable strip outside the outermost lanes, as in CARLA's towns, m."""
ROUTE_LANES = 6
"""Lanes in a route window: the one before, the current one and those ahead."""
PROJECTION_REACH = 4.0
"""How far from its guess a projection onto a route may lie, m."""


class Town(nn.Module):
    """A road network compiled into tensors, which move with ``.to(device)``.

    Distances along a lane are arc lengths of its centre line. A *route window* is ``[*B, 6]`` lane indices: the
    lane before, the current one and the four after it; a *route position* is an arc length counted from the start
    of the current lane, negative on the lane before it and running on over the lanes after it.

    Args:
        name: the name that episodes and reports use.
        network: a highway-env network whose lanes carry a ``manoeuvre`` (:class:`~ldrl.subtasks.SubTask`).

    Attributes:
        lane_length: ``[L]`` float32, m.
        lane_manoeuvre: ``[L]`` int64, the :class:`SubTask` of the lane; ``LANEFOLLOW`` outside junctions.
        lane_successors: ``[L, S]`` int64, padded by repeating the first successor.
        lane_successor_count: ``[L]`` int64.
        lane_predecessor: ``[L]`` int64, one lane that leads into the lane.
        lane_to_junction: ``[L]`` float32, from the lane's end to the entry of the next junction, m.
        road_distance: ``[1, 1, H, W]`` float32, see :class:`~ldrl.towns.surface.Surface`.
        lane_direction: ``[1, 2, H, W]`` float32, unit vector along the nearest lane on the road outside junctions,
            zero elsewhere.

    Raises:
        ValueError: a lane leads nowhere.

    Examples:
        >>> town = Town.load("town1")
        >>> len(town.approaches())
        36
    """

    lane_length: Tensor
    lane_spacing: Tensor
    lane_first: Tensor
    lane_manoeuvre: Tensor
    lane_pieces: Tensor
    lane_successors: Tensor
    lane_successor_count: Tensor
    lane_predecessor: Tensor
    lane_to_junction: Tensor
    points: Tensor
    headings: Tensor
    pieces: Tensor
    road_distance: Tensor
    lane_direction: Tensor
    raster_origin: Tensor

    def __init__(self, name: str, network: RoadNetwork) -> None:
        super().__init__()
        self.name = name
        self.network = network
        self.lane_indices = [
            (start, end, k)
            for start, ends in network.graph.items()
            for end, side_by_side in ends.items()
            for k in range(len(side_by_side))
        ]
        lanes = [network.get_lane(index) for index in self.lane_indices]
        self._register_lanes(lanes)
        self._register_links()
        self._register_surface(max(lane.width_at(0) for lane in lanes) / 2 + SHOULDER)

    @classmethod
    def load(cls, name: str) -> Town:
        """A built-in town.

        Args:
            name: ``"town1"`` or ``"town2"``.

        Raises:
            ValueError: no town has that name.
        """
        return cls(name, load_layout(name).network())

    def _buffer(self, name: str, value: Tensor | np.ndarray | list) -> None:
        self.register_buffer(name, torch.as_tensor(value), persistent=False)

    def _register_lanes(self, lanes: list) -> None:
        counts = [max(1, math.ceil(lane.length / LANE_SPACING)) for lane in lanes]
        stations = [np.linspace(0, lane.length, n + 1) for lane, n in zip(lanes, counts, strict=True)]
        points = [[lane.position(s, 0) for s in along] for lane, along in zip(lanes, stations, strict=True)]
        headings = [np.unwrap([lane.heading_at(s) for s in along]) for lane, along in zip(lanes, stations, strict=True)]
        self._buffer("points", np.concatenate(points).astype(np.float32))
        self._buffer("headings", np.concatenate(headings).astype(np.float32))
        self._buffer("lane_first", np.cumsum([0] + [n + 1 for n in counts[:-1]]))
        self._buffer("lane_length", np.array([lane.length for lane in lanes], np.float32))
        self._buffer("lane_spacing", self.lane_length / torch.tensor(counts))
        last = torch.tensor(counts) - 1
        self._buffer("lane_pieces", torch.stack((self.lane_length, self.lane_spacing, last, self.lane_first), -1))
        poses = torch.cat((self.points, self.headings.unsqueeze(-1)), -1)
        self._buffer("pieces", torch.cat((poses, poses.diff(dim=0, append=poses[-1:])), -1))
        self._buffer("lane_manoeuvre", [int(lane.manoeuvre) for lane in lanes])

    def _register_links(self) -> None:
        starts: dict[str, list[int]] = {}
        for i, (start, _, _) in enumerate(self.lane_indices):
            starts.setdefault(start, []).append(i)
        successors = [starts.get(end, []) for _, end, _ in self.lane_indices]
        predecessor = [0] * len(successors)
        for i, following in enumerate(successors):
            if not following:
                start, end, _ = self.lane_indices[i]
                raise ValueError(f"town {self.name!r}: the lane {start!r} to {end!r} leads nowhere; connect its end")
            for j in following:
                predecessor[j] = i
        width = max(map(len, successors))
        self._buffer("lane_successors", [row + row[:1] * (width - len(row)) for row in successors])
        self._buffer("lane_successor_count", [len(row) for row in successors])
        self._buffer("lane_predecessor", predecessor)
        self._buffer("lane_to_junction", [self._distance_to_junction(i) for i in range(len(successors))])

    def _distance_to_junction(self, lane: int) -> float:
        """Arc length from the end of ``lane`` to the next junction; infinite on a loop without one."""
        distance = 0.0
        for _ in self.lane_indices:
            lane = self.successors(lane)[0]
            if self.lane_manoeuvre[lane] != SubTask.LANEFOLLOW:
                return distance
            distance += float(self.lane_length[lane])
        return math.inf

    def _register_surface(self, half_width: float) -> None:
        rasters = surface.rasterise(self.points, self.headings, half_width, LANE_SPACING)
        lane_of_point = torch.searchsorted(self.lane_first, torch.arange(len(self.points)), right=True) - 1
        on_street = self.lane_manoeuvre[lane_of_point[rasters.nearest_point]] == SubTask.LANEFOLLOW
        on_street &= rasters.road_distance[0, 0] < 0
        heading = self.headings[rasters.nearest_point]
        direction = torch.stack((heading.cos(), heading.sin())) * on_street
        self._buffer("raster_origin", rasters.origin)
        self._buffer("road_distance", rasters.road_distance)
        self._buffer("lane_direction", direction.unsqueeze(0))

    def successors(self, lane: int) -> list[int]:
        """Indices of the lanes that follow ``lane``."""
        return self.lane_successors[lane, : int(self.lane_successor_count[lane])].tolist()

    def approaches(self) -> list[int]:
        """Indices of the lanes that lead straight into a junction."""
        return (self.lane_to_junction == 0).nonzero().squeeze(-1).tolist()

    def locate(self, route: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Find the lanes under positions on routes.

        Args:
            route: ``[*B, 6]`` integer, route windows.
            position: ``[*B, N]`` float32, route positions, m.

        Returns:
            ``[*B, N]`` int64 index into the window, and ``[*B, N]`` float32 arc length from that lane's start.
        """
        length = self.lane_length[route.long()]
        start = length.cumsum(-1) - length - length[..., :1]
        window = (torch.searchsorted(start.contiguous(), position.contiguous(), right=True) - 1).clamp(min=0)
        return window, position - start.gather(-1, window)

    def sample(self, route: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Points and headings of routes' centre lines.

        Args:
            route: ``[*B, 6]`` integer, route windows.
            position: ``[*B, N]`` float32, route positions, m; clamped to the window's lanes.

        Returns:
            ``[*B, N, 2]`` float32, m, and ``[*B, N]`` float32, rad.
        """
        window, along = self.locate(route, position)
        length, spacing, last, first = embedding(route.long().gather(-1, window), self.lane_pieces).unbind(-1)
        step = along.clamp(min=0).minimum(length) / spacing
        whole = step.floor().minimum(last)
        piece = embedding((first + whole).long(), self.pieces)
        pose = piece[..., :3] + (step - whole).unsqueeze(-1) * piece[..., 3:]
        return pose[..., :2], pose[..., 2]

    def project(self, route: Tensor, xy: Tensor, guess: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points onto routes.

        Args:
            route: ``[*B, 6]`` integer, route windows.
            xy: ``[*B, 2]`` float32, m.
            guess: ``[*B]`` float32, route positions within 4 m of the result, m.

        Returns:
            Three ``[*B]`` float32: route position (m), signed distance from the centre line, positive to its right
            (m), and the centre line's heading (rad).
        """
        steps = torch.arange(-PROJECTION_REACH, PROJECTION_REACH + LANE_SPACING, LANE_SPACING, device=xy.device)
        candidates = guess.unsqueeze(-1) + steps
        points, headings = self.sample(route, candidates)
        x, y = (xy.unsqueeze(-2) - points).unbind(-1)
        closest = (x.square() + y.square()).argmin(-1, keepdim=True)
        heading = headings.gather(-1, closest)
        along = x.gather(-1, closest) * heading.cos() + y.gather(-1, closest) * heading.sin()
        position = candidates.gather(-1, closest) + along.clamp(-LANE_SPACING, LANE_SPACING)
        point, heading = self.sample(route, position)
        offset, heading = xy - point.squeeze(-2), heading.squeeze(-1)
        cross_track = offset[..., 1] * heading.cos() - offset[..., 0] * heading.sin()
        return position.squeeze(-1), cross_track, heading

    def extra_repr(self) -> str:
        """Name and size."""
        return f"{self.name!r}, {len(self.lane_length)} lanes, {float(self.lane_length.sum()) / 1000:.1f} km"
