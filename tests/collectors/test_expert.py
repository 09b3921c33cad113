"""The expert: each controller by itself, every built-in episode, states that it would not have come to, and traffic."""

import math

import pytest
import torch

from ldrl import keys
from ldrl.collectors.expert import LOOK_AHEAD, Expert, expert_action
from ldrl.envs import TownEnv, vehicle
from ldrl.envs.camera import shift
from ldrl.envs.following import idm_acceleration
from ldrl.envs.vehicle import CRUISE_SPEED

FLAGS = (keys.OFF_ROAD, keys.WRONG_LANE, keys.COLLISION)


def test_drives_every_builtin_episode_perfectly(town, episodes):
    some, expert = episodes[town.name], Expert(town)
    env = TownEnv(town, episodes=some, seed=0)
    length = torch.tensor([episode.route(town).length for episode in some])
    td, live, track, driving = env.reset(), torch.ones(len(some), dtype=torch.bool), [], []
    while live.any():
        for flag in FLAGS:
            wrong = td[flag].squeeze(-1) & live
            assert not wrong.any(), (flag, [some[k].id for k in wrong.nonzero().flatten()])
        assert not (td["done"].squeeze(-1) & live).any()  # nobody runs out of time
        track.append(td[keys.POSE][:, :2])
        driving.append(live)
        live = live & (td[keys.PROGRESS].squeeze(-1) < length)
        td = env.step(expert(td))["next"]
    track, driving = torch.stack(track, 1), torch.stack(driving, 1)
    for k, episode in enumerate(some):
        gaps = torch.cdist(torch.tensor(episode.path), track[k][driving[k]]).amin(1)
        assert gaps.max() < 1.5, episode.id
        assert gaps[-1] < 0.7, episode.id


def test_speed_controller(town1):
    route, position = torch.tensor([[0] * 6] * 4), torch.full((4,), 5.0)
    points, headings = town1.sample(route, position.unsqueeze(-1))
    pose = torch.cat((points.squeeze(1), headings), -1)
    speed = torch.tensor([CRUISE_SPEED, CRUISE_SPEED - 1, 0.0, CRUISE_SPEED + 3])
    throttle = expert_action(town1, pose, speed, route, position)[:, 0]
    assert throttle.tolist() == pytest.approx([0.3, 0.3 + 0.54, 1.0, 0.0], abs=1e-5)


def test_holds_20_kilometres_an_hour(town2):
    env, expert = TownEnv(town2, 16, seed=0), Expert(town2)
    td = env.reset()
    for _ in range(60):
        td = env.step(expert(td))["next"]
    assert td[keys.SPEED].flatten().tolist() == pytest.approx([20 / 3.6] * 16, abs=0.05)


@pytest.mark.parametrize(("lateral", "yaw"), [(1.0, 0.0), (-1.0, 0.0), (0.0, 0.3), (0.0, -0.3), (0.8, -0.24)])
def test_returns_to_its_lane(town2, lateral, yaw):
    env, expert = TownEnv(town2, 32, seed=0), Expert(town2)
    td = env.reset()
    pose = shift(td[keys.POSE], lateral, yaw)
    position = td[keys.ROUTE_POSITION].squeeze(-1)
    steer = expert_action(town2, pose, td[keys.SPEED].squeeze(-1), td[keys.ROUTE], position)[:, 1]
    straight = expert_action(town2, td[keys.POSE], td[keys.SPEED].squeeze(-1), td[keys.ROUTE], position)[:, 1]
    assert (torch.sign(steer - straight) == -torch.sign(torch.tensor(lateral + LOOK_AHEAD * yaw))).all()
    env._state[:, :3] = pose.double()
    td = env._observe()
    for _ in range(40):
        td = env.step(expert(td))["next"]
    assert td[keys.CROSS_TRACK_ERROR].abs().max() < 0.6
    assert td[keys.CROSS_TRACK_ERROR].abs().median() < 0.05


def test_labels_do_not_depend_on_the_guess_or_the_batch(town2):
    td = TownEnv(town2, 32, seed=0).reset()
    pose, speed, route = td[keys.POSE], td[keys.SPEED].squeeze(-1), td[keys.ROUTE]
    position = td[keys.ROUTE_POSITION].squeeze(-1)
    actions = expert_action(town2, pose, speed, route, position)
    for off in (-3.0, 2.0):
        torch.testing.assert_close(expert_action(town2, pose, speed, route, position + off), actions, atol=5e-3, rtol=0)
    for k in range(0, 32, 5):
        alone = expert_action(town2, pose[k], speed[k], route[k], position[k])
        torch.testing.assert_close(alone, actions[k], atol=1e-5, rtol=1e-4)
    assert Expert(town2)(td)[keys.ACTION].equal(actions)
    assert (actions[:, 0] >= 0).all()
    assert (actions.abs() <= 1).all()


def test_drives_episodes_in_traffic(town, episodes):
    """Some short ones, among 20 cars: all arrive in time, none touches anything or leaves its lane."""
    some, expert = sorted(episodes[town.name], key=lambda episode: len(episode.path)), Expert(town)
    some = some[: len(some) // 2 : 5]
    env = TownEnv(town, episodes=some, traffic=20, seed={"town1": 1, "town2": 3}[town.name])
    length = torch.tensor([episode.route(town).length for episode in some])
    td, live, slowest = env.reset(), torch.ones(len(some), dtype=torch.bool), math.inf
    while live.any():
        td = env.step(expert(td.set("_step", live)))["next"]
        for flag in FLAGS:
            wrong = td[flag].squeeze(-1) & live
            assert not wrong.any(), (flag, [some[k].id for k in wrong.nonzero().flatten()])
        assert not (td["done"].squeeze(-1) & live).any()
        slowest = min(slowest, float(td[keys.SPEED].squeeze(-1)[live].min()))
        live = live & (td[keys.PROGRESS].squeeze(-1) < length)
    assert slowest < 3  # with these seeds somebody has to give way


def on_a_street(town, speed, before):
    """Arguments of ``expert_action`` for a car so many metres before a junction."""
    approach = next(lane for lane in town.approaches() if town.lane_length[lane] > 80)
    route = [int(town.lane_predecessor[approach]), approach]
    while len(route) < 6:
        route.append(town.successors(route[-1])[0])
    route, position = torch.tensor([route]), town.lane_length[approach].unsqueeze(0) - before
    point, heading = town.sample(route, position.unsqueeze(-1))
    return town, torch.cat((point[:, 0], heading), -1), torch.tensor([speed]), route, position


@pytest.mark.parametrize(("speed", "gap", "leader_speed"), [(5.0, 15.0, 2.0), (3.0, 30.0, 5.0), (0.0, 9.0, 0.0)])
def test_follows_as_an_idm_vehicle(town2, speed, gap, leader_speed):
    arguments, free = on_a_street(town2, speed, 60.0), torch.tensor([True])
    x, y, heading = arguments[1][0].tolist()
    leader = [x + gap * math.cos(heading), y + gap * math.sin(heading), heading, leader_speed]
    beside = [leader[0] + 4 * math.sin(heading), leader[1] - 4 * math.cos(heading), heading + math.pi, 5.0]
    nobody = [math.nan] * 4
    expected = idm_acceleration(*map(torch.tensor, (speed, CRUISE_SPEED, gap, leader_speed)))
    action = expert_action(*arguments, torch.tensor([[beside, leader, nobody]]), free)
    reached = vehicle.acceleration(action[0, 0], arguments[2][0])
    assert float(reached) == pytest.approx(max(float(expected), -speed / vehicle.TIME_STEP), abs=1e-3)
    alone = expert_action(*arguments, torch.tensor([[beside, nobody]]), free)
    assert torch.equal(alone, expert_action(*arguments, torch.tensor([[nobody]]), free))
    assert alone[0, 0] > action[0, 0]
    assert alone[0, 1] == expert_action(*arguments)[0, 1]


@pytest.mark.parametrize(
    ("before", "right_of_way", "brakes"), [(20.0, False, True), (20.0, True, False), (26.0, False, False)]
)
def test_stops_before_a_junction_that_others_have(town2, before, right_of_way, brakes):
    arguments = on_a_street(town2, 5.0, before)
    action = expert_action(*arguments, torch.full((1, 1, 4), math.nan), torch.tensor([right_of_way]))
    assert (vehicle.acceleration(action[0, 0], torch.tensor(5.0)) < 0) == brakes


def test_waits_at_the_stop_line(town2):
    env, expert = TownEnv(town2, 1, traffic=1, seed=0), Expert(town2)
    td = env.reset()
    _, pose, _, route, position = on_a_street(town2, 5.0, 24.0)
    env._route, env._position = route, position
    env._state[:, :3] = pose.double()
    td = env._observe()
    for _ in range(150):
        td[keys.RIGHT_OF_WAY] = torch.tensor([[False]])
        td = env.step(expert(td))["next"]
    to_entry = float(town2.lane_length[route[0, 1]]) - float(td[keys.ROUTE_POSITION])
    assert 2.5 < to_entry < 4.0
    assert td[keys.SPEED] < 0.05
