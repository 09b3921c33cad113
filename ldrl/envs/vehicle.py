"""The car: highway-env's kinematic bicycle model, batched, and its controls."""

from __future__ import annotations

import math

import torch
from highway_env.vehicle.kinematics import Vehicle
from torch import Tensor

__all__ = [
    "CRUISE_SPEED",
    "INITIAL_SPEED",
    "LENGTH",
    "MAX_ACCELERATION",
    "MAX_BRAKING",
    "MAX_STEERING_ANGLE",
    "ROLLING_RESISTANCE",
    "TIME_STEP",
    "WIDTH",
    "acceleration",
    "bicycle_step",
    "footprint",
    "overlap",
    "rolling_distance",
    "steer_towards",
    "throttle_for",
]

LENGTH = Vehicle.LENGTH
"""m."""
WIDTH = Vehicle.WIDTH
"""m."""
TIME_STEP = 0.1
"""10 Hz, s."""
CRUISE_SPEED = 20 / 3.6
"""Speed that an expert keeps (paper), m/s."""
INITIAL_SPEED = 4.7
"""Speed at the start of an episode (paper's evaluation), m/s."""
MAX_STEERING_ANGLE = math.pi / 3
"""Front wheel angle at full steer, as in highway-env's controlled vehicles, rad."""
MAX_ACCELERATION = 5.0
"""At full throttle, before rolling resistance; highway-env's continuous action has the same bound, m/s^2."""
MAX_BRAKING = 6.0
"""At full brake, besides rolling resistance: so all that highway-env's IDM asks for can be had at any speed, m/s^2."""
ROLLING_RESISTANCE = 1.5
"""Deceleration without throttle: from 20 km/h the car stops within 12 m, m/s^2."""
SETTLING_RATE = 5.0
"""Below ``ROLLING_RESISTANCE / SETTLING_RATE`` m/s the resistance fades with the speed, so that the car stops, 1/s."""


def acceleration(throttle: Tensor, speed: Tensor) -> Tensor:
    """Acceleration of the car: ``5 throttle - min(1.5, 5 speed)``, and 6 m/s^2 instead of 5 for the brake.

    The brake holds a car but does not push it back: it takes at most the speed that there is in the step.

    Args:
        throttle: ``[*B]`` in [-1, 1], negative brakes.
        speed: ``[*B]``, m/s.

    Returns:
        ``[*B]``, m/s^2.

    Examples:
        >>> acceleration(torch.tensor([0.0, 0.3, -1.0, -1.0]), torch.tensor([5.0, 5.0, 5.0, 0.1]))
        tensor([-1.5000,  0.0000, -7.5000, -1.0000])
    """
    resistance = _resistance(speed)
    braked = torch.maximum(MAX_BRAKING * throttle - resistance, -speed / TIME_STEP)
    return torch.where(throttle < 0, braked, MAX_ACCELERATION * throttle - resistance)


def throttle_for(acceleration: Tensor, speed: Tensor) -> Tensor:
    """The throttle of an acceleration: the inverse of :func:`acceleration`, as far as the car can.

    Args:
        acceleration: ``[*B]``, m/s^2.
        speed: ``[*B]``, m/s.

    Returns:
        ``[*B]`` in [-1, 1].

    Examples:
        >>> throttle_for(torch.tensor([0.0, -4.5, -9.0]), torch.tensor([5.0, 5.0, 5.0]))
        tensor([ 0.3000, -0.5000, -1.0000])
    """
    force = acceleration + _resistance(speed)
    return torch.where(force < 0, force / MAX_BRAKING, force / MAX_ACCELERATION).clamp(-1, 1)


def _resistance(speed: Tensor) -> Tensor:
    return (SETTLING_RATE * speed).clamp(-ROLLING_RESISTANCE, ROLLING_RESISTANCE)


def rolling_distance(speed: Tensor) -> Tensor:
    """How far the car rolls without throttle until it stands, within 0.3 m: ``speed^2 / (2 * 1.5)``.

    Args:
        speed: ``[*B]``, m/s.

    Returns:
        ``[*B]``, m.
    """
    return speed.square() / (2 * ROLLING_RESISTANCE)


def bicycle_step(state: Tensor, steering_angle: Tensor, acceleration: Tensor) -> Tensor:
    """One Euler step of highway-env's kinematic bicycle model.

    With slip angle ``beta = atan(tan(steering_angle) / 2)``: the position moves by ``speed dt`` along
    ``heading + beta``, the heading by ``speed sin(beta) / (length / 2) dt``, the speed by ``acceleration dt``.

    Args:
        state: ``[*B, 4]``: x, y (m), heading (rad), speed (m/s).
        steering_angle: ``[*B]``, of the front wheel, positive turns right, rad.
        acceleration: ``[*B]``, m/s^2; capped where the speed exceeds highway-env's 40 m/s.

    Returns:
        ``[*B, 4]``, the state 0.1 s later.
    """
    x, y, heading, speed = state.unbind(-1)
    too_fast = speed.abs() > Vehicle.MAX_SPEED
    braking = torch.minimum(acceleration * speed.sign(), Vehicle.MAX_SPEED - speed.abs()) * speed.sign()
    acceleration = torch.where(too_fast, braking, acceleration)
    slip = torch.atan(torch.tan(steering_angle) / 2)
    return torch.stack(
        (
            x + speed * torch.cos(heading + slip) * TIME_STEP,
            y + speed * torch.sin(heading + slip) * TIME_STEP,
            heading + speed * torch.sin(slip) / (LENGTH / 2) * TIME_STEP,
            speed + acceleration * TIME_STEP,
        ),
        -1,
    )


def steer_towards(forward: Tensor, right: Tensor) -> Tensor:
    """The steer whose circle through the car's origin meets a point: the bicycle model's exact pure pursuit.

    The origin leaves along the slip angle ``beta`` on a circle of curvature ``sin(beta) / (length / 2)``; it meets a
    point at distance ``d`` and bearing ``a`` where ``tan(beta) = length sin(a) / (d + length cos(a))``.

    Args:
        forward: ``[*B]``, the point ahead of the car's origin, m.
        right: ``[*B]``, the point right of it, m.

    Returns:
        ``[*B]`` in [-1, 1], clipped where the wheel would have to turn further.
    """
    distance = torch.hypot(forward, right)
    tan_slip = LENGTH * right / (distance.square() + LENGTH * forward)
    return (torch.atan(2 * tan_slip) / MAX_STEERING_ANGLE).clamp(-1, 1)


def footprint(pose: Tensor) -> Tensor:
    """Corners of the car: front right, rear right, rear left, front left.

    Args:
        pose: ``[*B, 3]``: x, y (m), heading (rad).

    Returns:
        ``[*B, 4, 2]``, m.
    """
    forward = pose.new_tensor([LENGTH, -LENGTH, -LENGTH, LENGTH]) / 2
    right = pose.new_tensor([WIDTH, WIDTH, -WIDTH, -WIDTH]) / 2
    cos, sin = pose[..., 2:].cos(), pose[..., 2:].sin()
    return torch.stack((pose[..., :1] + forward * cos - right * sin, pose[..., 1:2] + forward * sin + right * cos), -1)


def overlap(first: Tensor, second: Tensor, margin: float = 0.0) -> Tensor:
    """Whether cars touch: the separating axis theorem for their footprints.

    Args:
        first: ``[*B, 3]``: x, y (m), heading (rad).
        second: ``[*B, 3]``, the same; any shape that broadcasts.
        margin: by how much all sides of every car are moved out, m.

    Returns:
        ``[*B]`` bool; false where a pose is NaN.

    Examples:
        >>> overlap(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([[4.9, 1.9, 0.0], [3.6, 0.0, 1.57], [0.0, 2.1, 0.0]]))
        tensor([ True, False, False])
    """
    x, y, turn = (second - first).unbind(-1)
    half_length, half_width = LENGTH / 2 + margin, WIDTH / 2 + margin
    cos, sin = turn.cos().abs(), turn.sin().abs()
    along = half_length * (1 + cos) + half_width * sin
    across = half_width * (1 + cos) + half_length * sin
    touching = torch.ones_like(turn, dtype=torch.bool)
    for heading in (first[..., 2], second[..., 2]):
        towards, sideways = heading.cos(), heading.sin()
        touching = touching & ((x * towards + y * sideways).abs() < along)
        touching = touching & ((y * towards - x * sideways).abs() < across)
    return touching
