"""The town as a highway-env environment for Gymnasium, with highway-env's traffic, observations and rendering."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from highway_env import utils
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import action_factory
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import observation_factory
from highway_env.road.road import Road
from tensordict import TensorDictBase

from ldrl import keys
from ldrl.envs.episodes import FIELDS, Episode
from ldrl.envs.highway_road import IndexedRoad
from ldrl.envs.highway_spaces import ThrottleSteerAction, TownObservation
from ldrl.envs.highway_traffic import HighwayTraffic, mark_crossings
from ldrl.envs.town import TownEnv
from ldrl.envs.vehicle import TIME_STEP
from ldrl.towns import Town
from ldrl.towns.network import IndexedNetwork

__all__ = ["HighwayTownEnv"]

FREQUENCY = round(1 / TIME_STEP)
"""Of decisions, Hz."""


class HighwayTownEnv(AbstractEnv):
    """One car in a town, as a highway-env environment: the task of :class:`~ldrl.envs.TownEnv`.

    ``gymnasium.make`` knows it as ``ldrl/Town1-v0``, ``ldrl/Town2-v0`` and, for any town, ``ldrl/Town-v0``. The car,
    its observations, reward and ends are TownEnv's; traffic, collisions with it and pictures are highway-env's.
    Through TorchRL's ``GymWrapper`` it gives the same keys as TownEnv; :func:`~ldrl.envs.make_highway_env` stacks
    ldrl's transforms on it.

    Args:
        config: what differs from :meth:`default_config`. Besides highway-env's settings: ``town`` (a town or the name
            of one), ``episode`` (an :class:`~ldrl.envs.Episode` or a dictionary of its fields; None roams),
            ``max_steps`` (of a roaming episode), ``vehicles_count`` (other cars), ``indexed`` (False for
            highway-env's own road, which does the same and looks at the whole town at every step). The types of
            ``observation`` and ``action`` are highway-env's or the defaults ``"Town"`` and ``"ThrottleSteer"``.
        render_mode: ``"human"`` for a window, ``"rgb_array"`` for pictures, also without a display.
        town: the same as ``config["town"]``.

    Raises:
        ValueError: a setting is unknown or its value does not do; no room for so many cars; an episode of another
            town, or one whose start or path is off the road.

    Examples:
        >>> import gymnasium, ldrl
        >>> env = gymnasium.make("ldrl/Town1-v0", config={"vehicles_count": 5})
        >>> observation, _ = env.reset(seed=0)
        >>> observation["world"]["traffic"].shape
        (5, 4)
    """

    town: Town
    network: IndexedNetwork
    cars: TownEnv
    """What is known of the car besides where highway-env says that it is."""
    seen: TensorDictBase
    """What ``cars`` gave out last."""
    action_space: Space
    observation_space: Space
    viewer: EnvViewer | None

    def __init__(self, config: dict | None = None, render_mode: str | None = None, *, town: str | None = None) -> None:
        self._loaded: str | Path | Town | None = None
        if town is not None:
            config = {"town": town} | (config or {})
        super().__init__(config, render_mode)

    @classmethod
    def default_config(cls) -> dict:
        """highway-env's settings, with those of the town."""
        config = super().default_config()
        config.update(
            {
                "town": "town1",
                "episode": None,
                "max_steps": 1000,
                "vehicles_count": 0,
                "indexed": True,
                "observation": {"type": "Town"},
                "action": {"type": "ThrottleSteer"},
                "simulation_frequency": FREQUENCY,
                "policy_frequency": FREQUENCY,
                "other_vehicles_type": "ldrl.envs.highway_traffic.TrafficVehicle",
                "neighbour_vehicles_connected_lanes": True,
                "screen_width": 600,
                "screen_height": 600,
                "centering_position": [0.5, 0.5],
                "scaling": 6.0,
            }
        )
        return config

    def configure(self, config: dict | None) -> None:
        """Change settings.

        Args:
            config: what changes.

        Raises:
            ValueError: see the class.
        """
        unknown = set(config or {}) - set(self.default_config())
        if unknown:
            raise ValueError(f"unknown settings {sorted(unknown)}; there are {sorted(self.default_config())}")
        super().configure(config)
        check(self.config)
        wanted = self.config["town"]
        if wanted != self._loaded:
            self.town = wanted if isinstance(wanted, Town) else Town.load(wanted)
            self.network = IndexedNetwork(self.town.network.graph)
            mark_crossings(self.network)
            self._loaded = wanted
        episode = self.config["episode"]
        if isinstance(episode, Mapping):
            episode = Episode(**episode)
        episodes = None if episode is None else [episode]
        count, kind = self.config["vehicles_count"], utils.class_from_path(self.config["other_vehicles_type"])
        self.traffic = HighwayTraffic(self.town, count, kind) if count else None
        self.cars = TownEnv(
            self.town, 1, episodes=episodes, max_steps=self.config["max_steps"], traffic=self.traffic or 0
        )

    def define_spaces(self) -> None:
        """Make the spaces and what fills and reads them."""
        action, observation = self.config["action"], self.config["observation"]
        own_action, own_observation = action["type"] == "ThrottleSteer", observation["type"] == "Town"
        self.action_type = ThrottleSteerAction(self) if own_action else action_factory(self, action)
        self.observation_type = TownObservation(self) if own_observation else observation_factory(self, observation)
        enable(getattr(self.observation_type, "viewer", None))
        self.action_space = keep(self.action_space, self.action_type.space())
        self.observation_space = keep(self.observation_space, self.observation_type.space())

    def _reset(self) -> None:
        self.cars.set_seed(int(self.np_random.integers(2**31)))
        if self.config["indexed"]:
            self.road = IndexedRoad(self.network, np_random=self.np_random)
        else:
            self.road = Road(self.town.network, np_random=self.np_random)
        if self.traffic is not None:
            self.traffic.road = self.road
        self.seen = self.cars.reset()  # which puts the traffic on the road
        x, y, heading, speed = self.cars.state[0].tolist()
        self.vehicle = self.action_type.vehicle_class(self.road, [x, y], heading, speed)
        self.road.vehicles.insert(0, self.vehicle)

    def _simulate(self, action: Any = None) -> None:
        super()._simulate(action)
        driven = self.vehicle
        state = torch.tensor([[*driven.position, driven.heading, driven.speed]], dtype=torch.float64)
        self.seen = self.cars.follow(state)
        for key in (keys.COLLISION, "terminated", "done"):
            self.seen[key] = self.seen[key] | driven.crashed

    def _reward(self, action: Any) -> float:
        return float(self.seen["reward"])

    def _is_terminated(self) -> bool:
        return bool(self.seen["terminated"])

    def _is_truncated(self) -> bool:
        return bool(self.seen["truncated"])

    def render(self) -> np.ndarray | None:
        """Draw the surroundings of the car.

        Returns:
            ``[600, 600, 3]`` uint8 with the render mode ``"rgb_array"``.
        """
        if self.viewer is None and self.render_mode is not None:
            self.viewer = EnvViewer(self)
            enable(self.viewer)
        return super().render()


def enable(viewer: EnvViewer | None) -> None:
    """Let a viewer draw without a display; highway-env's gives black pictures where ``SDL_VIDEODRIVER`` is dummy."""
    if viewer is not None and viewer.offscreen:
        viewer.enabled = True


def keep(before: Space | None, after: Space) -> Space:
    """The space of before if it is the same: a reset must not forget what it was seeded with."""
    return before if before == after else after


def check(config: Mapping[str, Any]) -> None:
    """Raise a ValueError for values that would fail later or be misunderstood."""
    if not isinstance(config["town"], str | Path | Town):
        raise ValueError(f"town is {config['town']!r}; give a Town or the name of one")
    if not isinstance(config["episode"], Episode | Mapping | None):
        raise ValueError(f"episode is {config['episode']!r}; give an Episode, a dictionary of its fields, or None")
    if isinstance(config["episode"], Mapping) and set(config["episode"]) - {"stop"} != set(FIELDS):
        raise ValueError(f"episode has {', '.join(map(str, config['episode']))}; an episode has {', '.join(FIELDS)}")
    for name, least in (("vehicles_count", 0), ("max_steps", 1)):
        if type(config[name]) is not int or config[name] < least:
            raise ValueError(f"{name}={config[name]!r}; give a whole number from {least}")
    if config["policy_frequency"] != FREQUENCY or config["simulation_frequency"] % FREQUENCY:
        raise ValueError(
            f"policy_frequency={config['policy_frequency']}, simulation_frequency={config['simulation_frequency']}; "
            f"the car decides at {FREQUENCY} Hz, simulate at a multiple of it"
        )
    for name in ("action", "observation"):
        if not isinstance(config[name], Mapping) or "type" not in config[name]:
            raise ValueError(f"{name} is {config[name]!r}; give a dictionary with a type")
