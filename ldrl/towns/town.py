"""A town as tensors: its lanes, what follows them, and the drivable surface."""

from __future__ import annotations

import math
import re
import zlib
from copy import deepcopy
from pathlib import Path

import numpy as np
import torch
from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork
from torch import Tensor, nn
from torch.nn.functional import embedding

from ldrl.subtasks import SubTask
from ldrl.towns import opendrive, surface
from ldrl.towns.generator import random_layout
from ldrl.towns.ground import stations
from ldrl.towns.layout import LAYOUTS, load_layout
from ldrl.towns.scenery import REACH, Scenery
from ldrl.towns.surface import LANE_SPACING

__all__ = ["ROUTE_LANES", "Town"]

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
        network: a highway-env network whose lanes carry a ``manoeuvre`` (:class:`~ldrl.subtasks.SubTask`). Those of
            junctions may carry ``options``, the manoeuvres that the road offers which they come from; without, these
            are the ones that the lane before offers.
        seed: of the scenery; None takes it from the name, without folders.

    Attributes:
        lane_length: ``[L]`` float32, m.
        lane_manoeuvre: ``[L]`` int64, the :class:`SubTask` of the lane; ``LANEFOLLOW`` outside junctions.
        lane_successors: ``[L, S]`` int64, padded by repeating the first successor.
        lane_successor_count: ``[L]`` int64.
        lane_predecessor: ``[L]`` int64, one lane that leads into the lane.
        lane_options: for each lane of a junction what its road of entry offers there; empty for other lanes.
        lane_to_junction: ``[L]`` float32, from the lane's end to the entry of the next junction, m.
        half_width: ``[P]`` float32, half the width of the lane and its shoulder at each point, m.
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
    half_width: Tensor
    shoulder = SHOULDER
    _scenery: Scenery | None

    def __init__(self, name: str, network: RoadNetwork, seed: int | None = None) -> None:
        super().__init__()
        self.name = name
        self.seed = zlib.crc32(Path(name).name.encode()) if seed is None else seed
        self.register_module("_scenery", None)
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
        self.lane_options = [self._options(i, lane) for i, lane in enumerate(lanes)]
        self._register_surface()

    @classmethod
    def load(cls, name: str | Path) -> Town:
        """A built-in town, a random one, or the map in an OpenDRIVE file.

        Args:
            name: ``"town1"`` or ``"town2"``; ``"random-<seed>"`` or ``"random-<seed>-<blocks>"``, see
                :func:`~ldrl.towns.random_layout`; or the path of a file that ends in ``.xodr``, see
                :func:`~ldrl.towns.opendrive.load_network`. The town of a file is named like the file, without folder.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: no town has that name, or no town can be made of the file.

        Examples:
            >>> Town.load("random-7-4").name
            'random-7-4'
        """
        name = str(name)
        if name.endswith(".xodr"):
            return cls(Path(name).name, opendrive.load_network(name))
        random = re.fullmatch(r"random-(\d+)(?:-(\d+))?", name)
        if random:
            layout = random_layout(*(int(number) for number in random.groups() if number))
            return cls(layout.name, layout.network())
        if name not in LAYOUTS:
            known = ", ".join(LAYOUTS)
            raise ValueError(f"unknown town {name!r}; use one of {known}, random-<seed>, or the path of a .xodr file")
        return cls(name, load_layout(name).network())

    def on(self, device: torch.device | str) -> Town:
        """This town where it is on the device, else a copy that is; ``to`` moves it for all that use it."""
        device = torch.empty(0, device=device).device  # "cuda" is some "cuda:0"
        return self if self.points.device == device else deepcopy(self).to(device)

    def _buffer(self, name: str, value: Tensor | np.ndarray | list) -> None:
        self.register_buffer(name, torch.as_tensor(value), persistent=False)

    def _register_lanes(self, lanes: list) -> None:
        stations = [_stations(lane) for lane in lanes]
        counts = [len(along) - 1 for along in stations]
        points = [[lane.position(s, 0) for s in along] for lane, along in zip(lanes, stations, strict=True)]
        headings = [np.unwrap([lane.heading_at(s) for s in along]) for lane, along in zip(lanes, stations, strict=True)]
        self._buffer("points", np.concatenate(points).astype(np.float32))
        self._buffer("headings", np.concatenate(headings).astype(np.float32))
        self._buffer("lane_first", np.cumsum([0] + [n + 1 for n in counts[:-1]]))
        self._buffer("lane_length", np.array([lane.length for lane in lanes], np.float32))
        self._buffer("lane_spacing", self.lane_length / torch.tensor(counts))
        widths = [lane.width_at(s) for lane, along in zip(lanes, stations, strict=True) for s in along]
        self._buffer("half_width", np.array(widths, np.float32) / 2 + SHOULDER)
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

    def _options(self, i: int, lane: AbstractLane) -> frozenset[SubTask]:
        """What can be done at the junction that a lane belongs to by cars that come the same way."""
        beside = self.successors(int(self.lane_predecessor[i])) if lane.manoeuvre != SubTask.LANEFOLLOW else []
        return getattr(lane, "options", frozenset(SubTask(int(self.lane_manoeuvre[k])) for k in beside))

    def _distance_to_junction(self, lane: int) -> float:
        """Arc length from the end of ``lane`` to the next junction; infinite on a loop without one."""
        distance = 0.0
        for _ in self.lane_indices:
            lane = self.successors(lane)[0]
            if self.lane_manoeuvre[lane] != SubTask.LANEFOLLOW:
                return distance
            distance += float(self.lane_length[lane])
        return math.inf

    def _register_surface(self) -> None:
        try:
            reach = 2 * (REACH + float(self.half_width.max()))  # the scenery's rasters are larger
            surface.raster_size((self.points.amax(0) - self.points.amin(0) + reach).tolist())
            rasters = surface.rasterise(self.points, self.headings, self.half_width, LANE_SPACING)
        except ValueError as error:
            raise ValueError(f"town {self.name!r}: {error}") from None
        lane_of_point, _ = stations(self)
        on_street = self.lane_manoeuvre[lane_of_point[rasters.nearest_point]] == SubTask.LANEFOLLOW
        on_street &= rasters.road_distance[0, 0] < 0
        heading = self.headings[rasters.nearest_point]
        direction = torch.stack((heading.cos(), heading.sin())) * on_street
        self._buffer("raster_origin", rasters.origin)
        self._buffer("road_distance", rasters.road_distance)
        self._buffer("lane_direction", direction.unsqueeze(0))

    @property
    def scenery(self) -> Scenery:
        """What stands around the streets, built when first asked for."""
        if self._scenery is None:
            self._scenery = Scenery(self)
        return self._scenery

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


def _stations(lane: AbstractLane) -> np.ndarray:
    """The arc lengths at which a lane is sampled, both ends included, m."""
    return np.linspace(0, lane.length, max(1, math.ceil(lane.length / LANE_SPACING)) + 1)
