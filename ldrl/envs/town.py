"""The batched town environment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from ldrl import keys
from ldrl.envs import vehicle
from ldrl.envs.traffic import Agent, Traffic, random_turn
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES, Town
from ldrl.towns.ground import SIDEWALK
from ldrl.towns.surface import sample

if TYPE_CHECKING:
    from ldrl.envs.episodes import Episode

__all__ = ["TownEnv"]

WRONG_LANE_CORNERS = 2
"""Corners of the footprint in an oncoming lane that make the car drive in the wrong lane."""
STANDING_SPEED = 0.1
"""Below it a car stands, m/s."""
STANDING_STEPS = 30
"""A car that stands this long has ended its drive."""
PATIENCE = 15.0
"""Time beyond one and a half times what the path needs at cruise speed before an episode is cut off, s."""
TRAFFIC_PATIENCE = 2
"""With traffic an episode may take this many times as long."""
WAITING_DISTANCE = 25.0
"""A car that stands may be waiting for another one that is ahead of it and this near, m."""


class TownEnv(EnvBase):
    """Cars that each drive through a town of their own: throttle and steer in, their world out, at 10 Hz.

    A car follows a route: an episode's, or at random over every junction (roaming). The env draws no image and speaks
    no sentence: :class:`~ldrl.envs.DashCamera`, :class:`~ldrl.envs.Instruction` and
    :class:`~ldrl.envs.SubtaskLabels` are transforms, and :func:`~ldrl.envs.make_env` stacks them.

    ``action`` is ``[B, 2]`` float32, throttle in [0, 1] and steer in [-1, 1] (positive turns right); values outside
    are clipped. All else is under ``"world"``, see :mod:`ldrl.keys`. The reward is the distance driven along the
    route in the step, in metres. An episode terminates when the footprint reaches the buildings behind the 4 m
    sidewalks (``collision``) or when the car has stood for 3 s; it is truncated after ``max_steps``.

    With ``traffic`` every row is a world with so many other cars, :class:`~ldrl.envs.traffic.Traffic`. Then the
    throttle is in [-1, 1], where negative brakes, touching another car is a collision, too, and time that the car
    stands within 25 m of a car ahead of it does not count.

    Args:
        town: where to drive.
        num_cars: the batch size; left out when ``episodes`` are given.
        episodes: start and path of each car, one per row, instead of roaming.
        max_steps: length of a roaming episode; episodes are given one and a half times the time that their path
            takes at 20 km/h, and 15 s; with traffic twice that.
        traffic: other cars in each world: how many, or where they come from.
        device: where the tensors are.
        seed: of the env's own generator; parallel workers need one each, as by ``ParallelEnv.set_seed``.

    Raises:
        ValueError: no cars, an episode of another town, one whose start or path is off the road, or more traffic than
            the streets have room for.

    Examples:
        >>> env = TownEnv(Town.load("town1"), num_cars=3)
        >>> env.rollout(5, break_when_any_done=False)["world", "pose"].shape
        torch.Size([3, 5, 3])
    """

    def __init__(
        self,
        town: Town,
        num_cars: int | None = None,
        *,
        episodes: Sequence[Episode] | None = None,
        max_steps: int = 1000,
        traffic: int | Traffic = 0,
        device: torch.device | str = "cpu",
        seed: int = 0,
    ) -> None:
        if episodes is not None:
            if num_cars not in (None, len(episodes)):
                raise ValueError(f"num_cars={num_cars} but {len(episodes)} episodes; leave num_cars out")
            num_cars = len(episodes)
        if not num_cars or num_cars < 1:
            raise ValueError(f"num_cars={num_cars}: give at least one car, or a list of episodes")
        super().__init__(device=torch.device(device), batch_size=[num_cars])
        self.town = town.on(self.device)
        self.episodes = episodes
        self._generator = torch.Generator(self.device)
        self.set_seed(seed)
        self._state = torch.zeros(num_cars, 4, dtype=torch.float64, device=self.device)
        self._route = torch.zeros(num_cars, ROUTE_LANES, dtype=torch.long, device=self.device)
        self._position = torch.zeros(num_cars, device=self.device)
        self._progress = torch.zeros(num_cars, device=self.device)
        self._steps = torch.zeros(num_cars, dtype=torch.long, device=self.device)
        self._standing = torch.zeros(num_cars, dtype=torch.long, device=self.device)
        self._goal = torch.full((num_cars,), math.inf, device=self.device)
        self._stop = torch.zeros(num_cars, dtype=torch.bool, device=self.device)
        self._limit = torch.full((num_cars,), max_steps, device=self.device)
        self._on_street = (self.town.lane_manoeuvre == SubTask.LANEFOLLOW).nonzero().squeeze(-1)
        self._plan = torch.zeros(num_cars, 1, dtype=torch.long, device=self.device)
        self._plan_length = torch.zeros(num_cars, dtype=torch.long, device=self.device)
        self._planned = torch.zeros(num_cars, dtype=torch.long, device=self.device)
        if episodes is not None:
            self._load(episodes)
        starts = self.town.points if episodes is None else self._plan_pose[:, :2].float()
        self._traffic: Traffic | None = None
        if isinstance(traffic, Traffic):
            self._traffic = traffic
        elif traffic:
            self._traffic = Traffic(self.town, num_cars, traffic, self._generator, starts)
        if episodes is not None and traffic:
            self._limit *= TRAFFIC_PATIENCE
        self._make_specs()

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device

        def real(*shape: int) -> Unbounded:
            return Unbounded((*batch, *shape), device=device)

        def flag() -> Binary:
            return Binary(1, (*batch, 1), device=device, dtype=torch.bool)

        lanes = len(self.town.lane_length)
        self.observation_spec = Composite(shape=batch, device=device)
        self.observation_spec[keys.POSE] = real(3)
        self.observation_spec[keys.ROUTE] = Bounded(0, lanes - 1, (*batch, ROUTE_LANES), device, torch.int16)
        for key in (keys.SPEED, keys.ROUTE_POSITION, keys.PROGRESS, keys.REMAINING, keys.CROSS_TRACK_ERROR):
            self.observation_spec[key] = real(1)
        for key in (keys.OFF_ROAD, keys.WRONG_LANE, keys.COLLISION):
            self.observation_spec[key] = flag()
        if self._traffic is not None:
            self.observation_spec[keys.TRAFFIC] = real(*self._traffic.state.shape[1:])
            self.observation_spec[keys.RIGHT_OF_WAY] = flag()
        self.action_spec = Bounded(
            torch.tensor([self._least_throttle, -1.0]).expand(*batch, 2),
            torch.tensor([1.0, 1.0]).expand(*batch, 2),
            device=device,
        )
        self.reward_spec = real(1)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=batch, device=device)

    def _load(self, episodes: Sequence[Episode]) -> None:
        routes = [episode.route(self.town) for episode in episodes]
        width = max(len(route.lanes) for route in routes)
        plan = [route.lanes + route.lanes[-1:] * (width - len(route.lanes)) for route in routes]
        self._plan = torch.tensor(plan, device=self.device)
        self._plan_length = torch.tensor([len(route.lanes) for route in routes], device=self.device)
        self._plan_start = torch.tensor([route.start for route in routes], device=self.device)
        self._plan_pose = torch.tensor([e.start for e in episodes], dtype=torch.float64, device=self.device)
        self._goal = torch.tensor([route.length for route in routes], device=self.device)
        self._stop = torch.tensor([episode.stop for episode in episodes], device=self.device)
        seconds = [1.5 * route.length / vehicle.CRUISE_SPEED + PATIENCE for route in routes]
        self._limit = torch.tensor([math.ceil(s / vehicle.TIME_STEP) for s in seconds], device=self.device)

    def to(self, *args: Any, **kwargs: Any) -> TownEnv:
        """Nothing but to where it is: its state and its generator stay.

        Raises:
            ValueError: that is another device.
        """
        device = torch.empty(0, device=self.device).to(*args, **kwargs).device
        if device != self.device:
            raise ValueError(f"the env is on {self.device}; make it with device={str(device)!r} instead")
        return super().to(*args, **kwargs)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(seed)

    @property
    def _least_throttle(self) -> float:
        return 0.0 if self._traffic is None else -1.0

    def _following(self, lane: Tensor, k: Tensor | int) -> Tensor:
        """The lane after ``lane`` of each car's route: the plan's lane ``k``, behind its end a random one."""
        following = random_turn(self.town, lane, self._generator)
        k = torch.as_tensor(k, device=self.device).expand(self.batch_size)
        planned = self._plan.gather(-1, k.clamp(max=self._plan.shape[-1] - 1).unsqueeze(-1)).squeeze(-1)
        return torch.where(k < self._plan_length, planned, following)

    def _start(self) -> tuple[Tensor, Tensor, Tensor]:
        """First lane, route position and pose of every car."""
        if self.episodes is not None:
            return self._plan[:, 0], self._plan_start, self._plan_pose
        weights = self.town.lane_length[self._on_street]
        lane = self._on_street[weights.multinomial(self.numel(), True, generator=self._generator)]
        part = torch.rand(self.batch_size, generator=self._generator, device=self.device)
        position = part * self.town.lane_length[lane]
        point, heading = self.town.sample(lane.unsqueeze(-1).expand(-1, ROUTE_LANES), position.unsqueeze(-1))
        return lane, position, torch.cat((point.squeeze(1), heading), -1).double()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        reset = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self._steps, dtype=torch.bool) if reset is None else reset.view(self.batch_size)
        lane, position, pose = self._start()
        route = [self.town.lane_predecessor[lane], lane]
        while len(route) < ROUTE_LANES:
            route.append(self._following(route[-1], len(route) - 1))
        state = torch.cat((pose, pose.new_full((*self.batch_size, 1), vehicle.INITIAL_SPEED)), -1)
        self._state = torch.where(mask.unsqueeze(-1), state, self._state)
        self._route = torch.where(mask.unsqueeze(-1), torch.stack(route, -1), self._route)
        self._planned = self._planned.masked_fill(mask, ROUTE_LANES - 1)
        self._position = torch.where(mask, position, self._position)
        self._progress = self._progress.masked_fill(mask, 0)  # a new tensor: the one before is in the step's output
        self._steps.masked_fill_(mask, 0)
        self._standing.masked_fill_(mask, 0)
        if self._traffic is not None:
            self._traffic.reset(mask, self._state[:, :3].float())
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        moving = tensordict.get("_step", None)
        mask = torch.ones_like(self._steps, dtype=torch.bool) if moving is None else moving.view(self.batch_size)
        if self._traffic is not None:
            here = self._state.float()
            self._traffic.step(mask, Agent(here[:, :3], here[:, 3], self._route, self._position))
        throttle, steer = tensordict[keys.ACTION].double().unbind(-1)
        speed = self._state[:, 3]
        state = vehicle.bicycle_step(
            self._state,
            steer.clamp(-1, 1) * vehicle.MAX_STEERING_ANGLE,
            vehicle.acceleration(throttle.clamp(self._least_throttle, 1), speed),
        )
        return self.follow(torch.where(mask.unsqueeze(-1), state, self._state), mask)

    @property
    def state(self) -> Tensor:
        """``[B, 4]`` float64: x, y (m), heading (rad), speed (m/s)."""
        return self._state

    def follow(self, state: Tensor, mask: Tensor | None = None) -> TensorDictBase:
        """What a step gives out when the cars have come to a state, be it by another simulator's physics.

        Args:
            state: ``[B, 4]`` float64, 0.1 s after the last one: x, y (m), heading (rad), speed (m/s).
            mask: ``[B]`` bool, the cars that were to move; None for all.
        """
        mask = torch.ones_like(self._steps, dtype=torch.bool) if mask is None else mask
        self._state, before = state, self._progress
        self._advance(mask)
        self._steps += mask
        out = self._observe()
        stands = self._state[:, 3] < STANDING_SPEED
        standing = (self._standing + 1) * stands
        if self._traffic is not None:
            waits = self._traffic.any_ahead(out[keys.POSE], WAITING_DISTANCE)
            standing = torch.where(waits, self._standing * stands, standing)
        self._standing = torch.where(mask, standing, self._standing)
        out["reward"] = (self._progress - before).unsqueeze(-1)
        terminated = out[keys.COLLISION] | (self._standing >= STANDING_STEPS).unsqueeze(-1)
        truncated = (self._steps >= self._limit).unsqueeze(-1)
        out.update({"terminated": terminated, "truncated": truncated, "done": terminated | truncated})
        return out

    def _advance(self, mask: Tensor) -> None:
        """Move each car along its route, and the route's window with it."""
        guess = self._position + self._state[:, 3].float() * vehicle.TIME_STEP
        position, _, _ = self.town.project(self._route, self._state[:, :2].float(), guess)
        position = torch.where(mask, position, self._position)
        self._progress = self._progress + position - self._position
        length = self.town.lane_length[self._route[:, 1]]
        passed = position >= length
        self._position = torch.where(passed, position - length, position)
        following = self._following(self._route[:, -1], self._planned)
        shifted = torch.cat((self._route[:, 1:], following.unsqueeze(-1)), -1)
        self._planned = self._planned + passed
        self._route = torch.where(passed.unsqueeze(-1), shifted, self._route)

    def _observe(self) -> TensorDictBase:
        pose = self._state[:, :3].float()
        corners = vehicle.footprint(pose)
        beyond_edge = sample(self.town.road_distance, self.town.raster_origin, corners).squeeze(-1)
        direction = sample(self.town.lane_direction, self.town.raster_origin, corners, "nearest")
        along = torch.stack((pose[:, 2].cos(), pose[:, 2].sin()), -1).unsqueeze(1)
        oncoming = (direction * along).sum(-1) < 0
        _, cross_track, _ = self.town.project(self._route, pose[:, :2], self._position)
        out = TensorDict(batch_size=self.batch_size, device=self.device)
        out[keys.POSE] = pose
        out[keys.SPEED] = self._state[:, 3:].float()
        out[keys.ROUTE] = self._route.short()
        out[keys.ROUTE_POSITION] = self._position.unsqueeze(-1)
        out[keys.PROGRESS] = self._progress.unsqueeze(-1)
        rolls = vehicle.rolling_distance(self._state[:, 3].float()) * self._stop
        out[keys.REMAINING] = (self._goal - self._progress - rolls).unsqueeze(-1)
        out[keys.CROSS_TRACK_ERROR] = cross_track.unsqueeze(-1)
        out[keys.OFF_ROAD] = (beyond_edge > 0).any(-1, keepdim=True)
        out[keys.WRONG_LANE] = oncoming.sum(-1, keepdim=True) >= WRONG_LANE_CORNERS
        out[keys.COLLISION] = (beyond_edge > SIDEWALK).any(-1, keepdim=True)
        if self._traffic is not None:
            out[keys.TRAFFIC] = self._traffic.state
            out[keys.RIGHT_OF_WAY] = self._traffic.right_of_way(self._route, self._position).unsqueeze(-1)
            touching = vehicle.overlap(pose.unsqueeze(1), self._traffic.state[..., :3])
            out[keys.COLLISION] |= touching.any(-1, keepdim=True)
        return out
