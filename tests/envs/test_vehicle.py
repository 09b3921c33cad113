"""The car against hand-computed cases and against where it should end up."""

import math

import numpy as np
import pytest
import torch
from highway_env.utils import are_polygons_intersecting
from highway_env.vehicle.kinematics import Vehicle

from ldrl.envs import vehicle


def test_straight_ahead_by_hand():
    after = vehicle.bicycle_step(torch.tensor([1.0, 2.0, 0.0, 5.0]), torch.tensor(0.0), torch.tensor(1.5))
    assert after.tolist() == pytest.approx([1.5, 2.0, 0.0, 5.15])


def test_a_right_turn_by_hand():
    """Heading south at 4 m/s, wheels turned so far right that the slip angle is 30 degrees."""
    steering_angle = torch.tensor(math.atan(2 * math.tan(math.pi / 6)))
    state = torch.tensor([0.0, 0.0, math.pi / 2, 4.0])
    after = vehicle.bicycle_step(state, steering_angle, torch.tensor(0.0))
    # it moves 0.4 m along 120 degrees, clockwise from east, and turns 4 m/s * 0.5 / 2.5 m * 0.1 s to the right
    assert after.tolist() == pytest.approx([-0.2, 0.4 * math.sqrt(3) / 2, math.pi / 2 + 0.08, 4.0], abs=1e-6)


def test_throttle_map():
    throttle = torch.tensor([0.0, 0.0, 0.0, 0.3, 1.0, 1.0])
    speed = torch.tensor([5.0, 0.1, 0.0, 5.0, 5.0, 0.0])
    assert vehicle.acceleration(throttle, speed).tolist() == pytest.approx([-1.5, -0.5, 0, 0, 3.5, 5])


def test_rolls_to_a_stop_within_12_metres():
    state = torch.tensor([0.0, 0.0, 0.0, 20 / 3.6], dtype=torch.float64)
    speeds = []
    for _ in range(100):
        zero = state.new_zeros(())
        state = vehicle.bicycle_step(state, zero, vehicle.acceleration(zero, state[3]))
        speeds.append(float(state[3]))
    assert 8 < state[0] < 12
    assert min(speeds) >= 0  # never backwards
    assert speeds[-1] < 1e-6


@pytest.mark.parametrize("speed", [0.2, 1.0, 4.7, 20 / 3.6])
def test_rolling_distance_is_how_far_it_rolls(speed):
    state, zero = torch.tensor([0.0, 0.0, 0.0, speed], dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)
    for _ in range(100):
        state = vehicle.bicycle_step(state, zero, vehicle.acceleration(zero, state[3]))
    assert float(vehicle.rolling_distance(torch.tensor(speed))) == pytest.approx(float(state[0]), abs=0.3)


def test_brake():
    throttle, speed = torch.tensor([-1.0, -0.5, -1.0, -0.1]), torch.tensor([5.0, 5.0, 0.3, 0.0])
    assert vehicle.acceleration(throttle, speed).tolist() == pytest.approx([-7.5, -4.5, -3.0, 0.0])


def test_full_brake_stops_within_2_3_metres_and_stays():
    state, brake = torch.tensor([0.0, 0.0, 0.0, 20 / 3.6], dtype=torch.float64), torch.tensor(-1.0).double()
    speeds = []
    for _ in range(20):
        state = vehicle.bicycle_step(state, torch.zeros_like(brake), vehicle.acceleration(brake, state[3]))
        speeds.append(float(state[3]))
    assert 2.0 < state[0] < 2.4
    assert min(speeds) > -1e-12
    assert speeds[8:] == pytest.approx([0.0] * 12, abs=1e-12)


def test_throttle_for_is_the_inverse():
    throttle = torch.linspace(-1, 1, 41).unsqueeze(-1)
    speed = torch.tensor([0.3, 1.0, 5.0])
    acceleration = vehicle.acceleration(throttle, speed)
    reversing = throttle * vehicle.MAX_BRAKING - (5 * speed).clamp(max=1.5) < -speed / vehicle.TIME_STEP
    torch.testing.assert_close(
        vehicle.throttle_for(acceleration, speed)[~reversing], throttle.expand(-1, 3)[~reversing]
    )
    assert vehicle.throttle_for(torch.tensor([9.0, -9.0]), torch.tensor(5.0)).tolist() == [1.0, -1.0]


def test_speed_is_capped_as_in_highway_env():
    after = vehicle.bicycle_step(torch.tensor([0.0, 0.0, 0.0, 43.0]), torch.tensor(0.0), torch.tensor(5.0))
    assert float(after[3]) == pytest.approx(42.7)


@pytest.mark.parametrize(("forward", "right"), [(8.0, 0.0), (6.0, 1.0), (3.5, -0.8), (10.0, -6.0), (2.0, 2.0)])
def test_steer_towards_meets_the_point(forward, right, monkeypatch):
    monkeypatch.setattr(vehicle, "TIME_STEP", 1e-4)
    point = torch.tensor([forward, right], dtype=torch.float64)
    steer = vehicle.steer_towards(point[0], point[1])
    assert abs(steer) < 1
    state, closest = torch.tensor([0.0, 0.0, 0.0, 50.0], dtype=torch.float64), math.inf
    for _ in range(4000):
        state = vehicle.bicycle_step(state, steer * vehicle.MAX_STEERING_ANGLE, point.new_zeros(()))
        closest = min(closest, float((state[:2] - point).norm()))
    assert closest < 0.01


def test_steer_towards_is_bounded_and_finite():
    forward, right = torch.tensor([0.5, 0.5, 0.0, 3.0]), torch.tensor([2.0, -2.0, 1.0, 0.0])
    assert vehicle.steer_towards(forward, right).tolist() == pytest.approx([1.0, -1.0, 1.0, 0.0])


def test_overlap_equals_highway_envs_polygons():
    generator = np.random.default_rng(0)
    pose = generator.uniform((-5, -5, -4), (5, 5, 4), (400, 3))
    found = vehicle.overlap(torch.zeros(3, dtype=torch.float64), torch.tensor(pose))
    polygons = [Vehicle(None, xy, heading).polygon() for *xy, heading in pose]
    still = np.zeros(2)
    first = Vehicle(None, [0.0, 0.0], 0.0).polygon()
    expected = [are_polygons_intersecting(first, polygon, still, still)[0] for polygon in polygons]
    assert found.tolist() == expected
    assert 50 < sum(expected) < 350


def test_overlap_with_a_margin_and_nobody():
    apart, none = torch.tensor([5.4, 0.0, 0.0]), torch.tensor([math.nan] * 3)
    origin = torch.zeros(3)
    assert not vehicle.overlap(origin, apart)
    assert not vehicle.overlap(origin, apart, 0.19)
    assert vehicle.overlap(origin, apart, 0.21)
    assert not vehicle.overlap(origin, none, 9.0)


def test_footprint():
    corners = vehicle.footprint(torch.tensor([[10.0, 20.0, 0.0], [10.0, 20.0, math.pi / 2]]))
    assert corners[0].flatten().tolist() == pytest.approx([12.5, 21, 7.5, 21, 7.5, 19, 12.5, 19])
    assert corners[1].flatten().tolist() == pytest.approx([9, 22.5, 9, 17.5, 11, 17.5, 11, 22.5], abs=1e-5)
