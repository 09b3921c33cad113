"""What goes into the highway-env environment and what comes out by default: TownEnv's action and observation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType
from highway_env.vehicle.kinematics import Vehicle
from torchrl.data import Bounded, TensorSpec

from ldrl import keys
from ldrl.envs.vehicle import MAX_STEERING_ANGLE, acceleration

__all__ = ["ThrottleSteerAction", "TownObservation"]


class ThrottleSteerAction(ActionType):
    """Throttle in [0, 1], with traffic [-1, 1] where negative brakes, and steer in [-1, 1], positive turns right."""

    def space(self) -> Box:
        """Throttle and steer, float32."""
        return _box(self.env.cars.action_spec)

    @property
    def vehicle_class(self) -> type[Vehicle]:
        """highway-env's kinematic bicycle model."""
        return Vehicle

    def act(self, action: np.ndarray) -> None:
        """Set the wheel and the acceleration; values outside the space are clipped."""
        space = self.env.action_space
        throttle, steer = np.clip(np.asarray(action, np.float64), space.low, space.high)
        driven = self.controlled_vehicle
        speed = torch.tensor(driven.speed, dtype=torch.float64)
        accelerated = acceleration(torch.tensor(throttle), speed)
        driven.act({"steering": steer * MAX_STEERING_ANGLE, "acceleration": float(accelerated)})


class TownObservation(ObservationType):
    """What :class:`~ldrl.envs.TownEnv` tells, as a dictionary: ``observation["world"]["pose"]`` and so on."""

    def space(self) -> Dict:
        """Arrays of the shapes and types of TownEnv's rows."""
        world = self.env.cars.observation_spec[keys.WORLD]
        return Dict({keys.WORLD: Dict({name: _box(spec) for name, spec in world.items()})})

    def observe(self) -> dict:
        """The world now."""
        return {keys.WORLD: {name: value[0].numpy() for name, value in self.env.seen[keys.WORLD].items()}}


def _box(spec: TensorSpec) -> Box:
    """The space of a row of a TownEnv's spec."""
    example: Any = spec.zero()[0].numpy()
    low, high = -np.inf, np.inf
    if spec.dtype == torch.bool:
        low, high = 0, 1
    elif isinstance(spec, Bounded):
        low, high = spec.space.low[0].numpy(), spec.space.high[0].numpy()
    return Box(low, high, example.shape, dtype=example.dtype.type)
