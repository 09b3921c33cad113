"""The expert: each controller by itself, every built-in episode, and states that it would not have come to."""

import pytest
import torch

from ldrl import keys
from ldrl.collectors.expert import LOOK_AHEAD, Expert, expert_action
from ldrl.envs import TownEnv
from ldrl.envs.camera import shift
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
