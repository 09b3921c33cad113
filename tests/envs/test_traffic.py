"""Traffic: nobody touches and everybody moves, in every world alike, and what it does to the env."""

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import TownEnv, vehicle
from ldrl.envs.traffic import Traffic
from ldrl.subtasks import SubTask


def touching(poses):
    """How many pairs of cars of the same world touch, ``[W, N, 3]``."""
    pairs = vehicle.overlap(poses.unsqueeze(2), poses.unsqueeze(1)).sum((1, 2)) - poses.shape[1]
    return int(pairs.sum())


def steer_clear(traffic, seconds, agent):
    """Drive on; distances driven, ``[W, N]``."""
    driven = torch.zeros_like(traffic._speed)
    for _ in range(10 * seconds):
        traffic.step(torch.ones(len(driven), dtype=torch.bool), agent)
        assert touching(traffic.state[..., :3]) == 0
        driven += traffic.state[..., 3] * vehicle.TIME_STEP
    return driven


@pytest.mark.parametrize("name", ["town1", "town2", "crossing"])
def test_a_minute_of_traffic(request, name, nobody):
    town = request.getfixturevalue(name)
    traffic = Traffic(town, 6, 20, torch.Generator().manual_seed(0), town.points)
    traffic.reset(torch.ones(6, dtype=torch.bool), nobody(6).pose)
    driven = steer_clear(traffic, 60, nobody(6))
    assert driven.min() > 100
    assert driven.mean(-1).min() > 200  # of 300 m at 18 km/h
    lanes = town.lane_manoeuvre[traffic._route.flatten()]
    assert set(lanes.tolist()) == {SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT, SubTask.LANEFOLLOW}


def test_cars_stay_on_their_lanes_and_keep_to_their_speeds(town2):
    env = TownEnv(town2, 8, traffic=10, seed=0)
    td, expert = env.reset(), Expert(town2)
    for _ in range(100):
        before, td = td[keys.TRAFFIC], env.step(expert(td))["next"]
        step = (td[keys.TRAFFIC] - before)[..., :2].norm(dim=-1)
        torch.testing.assert_close(step, before[..., 3] * vehicle.TIME_STEP, atol=0.02, rtol=0)
        assert (td[keys.TRAFFIC][..., 3] - before[..., 3]).abs().max() <= 0.6 + 1e-5
        lanes = torch.cdist(td[keys.TRAFFIC][..., :2].flatten(0, 1), town2.points)
        assert lanes.amin(-1).max() < 0.3
        assert (td[keys.TRAFFIC][..., 3] < 20 / 3.6 + 1e-4).all()


def test_starts(town, episodes):
    for env in (
        TownEnv(town, 64, traffic=20, seed=0),
        TownEnv(town, episodes=episodes[town.name][:64], traffic=20, seed=0),
    ):
        traffic = env.reset()[keys.TRAFFIC]
        gaps = torch.cdist(traffic[..., :2], traffic[..., :2]) + 1e6 * torch.eye(20)
        heads = (traffic[:, :, None, 2] - traffic[:, None, :, 2]).cos() > 0.9
        assert gaps[heads].min() > 14  # one behind the other
        assert touching(traffic[..., :3]) == 0
        assert (traffic[..., :2] - env._state[:, None, :2]).norm(dim=-1).min() > 17
        assert (town.lane_manoeuvre[env._traffic._route[..., 1]] == SubTask.LANEFOLLOW).all()
        speed = traffic[..., 3]
        assert 16 / 3.6 <= speed.min() < 17 / 3.6
        assert 19 / 3.6 < speed.max() <= 20 / 3.6
        assert len(traffic[..., :2].flatten(0, 1).unique(dim=0)) == 64 * 20


def test_specs_and_keys(town2, episodes):
    for env in (TownEnv(town2, 3, traffic=4, seed=0), TownEnv(town2, episodes=episodes["town2"][:3], traffic=4)):
        check_env_specs(env)
        td = env.reset()
        assert td[keys.TRAFFIC].shape == (3, 4, 4)
        assert td[keys.TRAFFIC].dtype == torch.float32
        assert td[keys.RIGHT_OF_WAY].shape == (3, 1)
        assert env.action_spec.space.low[0].tolist() == [-1, -1]
    alone = TownEnv(town2, 3, seed=0)
    assert not {keys.TRAFFIC, keys.RIGHT_OF_WAY} & set(alone.reset().keys(True))
    assert alone.action_spec.space.low[0].tolist() == [0, -1]


@pytest.mark.parametrize(("traffic", "least"), [(0, -1.5), (2, -7.5)])
def test_the_brake_works_with_traffic_only(town2, traffic, least):
    env = TownEnv(town2, 2, traffic=traffic, seed=0)
    td = env.reset()
    td[keys.ACTION] = torch.tensor([-2.0, 0.0]).expand(2, 2)
    assert env.step(td)["next", keys.SPEED].flatten().tolist() == pytest.approx([4.7 + least / 10] * 2)


def test_same_seed_same_traffic(town2):
    def rollout(seed):
        env = TownEnv(town2, 4, traffic=6, max_steps=20)
        env.set_seed(seed)
        return env.rollout(50, Expert(town2), break_when_any_done=False)

    first, again, other = rollout(5), rollout(5), rollout(6)
    assert (first == again).all()
    assert not torch.equal(first[keys.TRAFFIC], other[keys.TRAFFIC])


def test_a_partial_reset_and_the_step_mask_leave_other_worlds_alone(town2):
    env = TownEnv(town2, 4, traffic=8, seed=0)
    td, expert = env.reset(), Expert(town2)
    for _ in range(60):
        td = env.step(expert(td))["next"]
    fields = ("_route", "_position", "_speed", "_desired", "_may_enter", "_waited", "_path")
    before = {name: getattr(env._traffic, name).clone() for name in fields}
    kept, mask = td.clone(), torch.tensor([True, False, False, True])
    fresh = env.reset(td.clone().set("_reset", mask.unsqueeze(-1)))
    assert torch.equal(fresh[keys.TRAFFIC][~mask], td[keys.TRAFFIC][~mask])
    assert (fresh[keys.TRAFFIC][mask] != td[keys.TRAFFIC][mask]).any(-1).all()
    assert all(torch.equal(getattr(env._traffic, name)[~mask], before[name][~mask]) for name in fields)
    before = {name: getattr(env._traffic, name).clone() for name in fields}
    stepped = env._step(expert(fresh.clone()).set("_step", mask.unsqueeze(-1)))
    assert all(torch.equal(getattr(env._traffic, name)[~mask], before[name][~mask]) for name in fields)
    assert (stepped[keys.TRAFFIC][mask] != fresh[keys.TRAFFIC][mask]).any(-1).all()
    assert (td == kept).all()  # nor has what was given out before


def test_touching_another_car_is_a_collision_and_ends_the_episode(town2):
    env = TownEnv(town2, 2, traffic=3, seed=0)
    td = env.reset()
    env._state[0, :3] = td[keys.TRAFFIC][0, 1, :3].double()
    env._state[0, :2] += 0.5
    td[keys.ACTION] = torch.zeros(2, 2)
    td = env.step(td)["next"]
    for key in (keys.COLLISION, "terminated", "done"):
        assert td[key].flatten().tolist() == [True, False]


def test_traffic_stops_for_a_standing_agent_wherever_it_is(town2):
    """Agents across the road, in either direction, without a route: nobody runs into them."""
    env = TownEnv(town2, 24, traffic=30, seed=0, max_steps=10**6)
    td = env.reset()
    env._state[:, 2] += torch.linspace(0, 2 * math.pi, 24)
    env._state[:, 3] = 0
    td[keys.ACTION] = torch.tensor([-1.0, 0.0]).expand(24, 2)
    stopped = torch.zeros(24, dtype=torch.bool)
    for _ in range(400):
        after = env.step(td)["next"]
        assert not after[keys.COLLISION].any()
        near = (after[keys.TRAFFIC][..., :2] - after[keys.POSE][:, None, :2]).norm(dim=-1) < 12
        stopped |= (near & (after[keys.TRAFFIC][..., 3] < 0.1)).any(-1)
    assert stopped.sum() > 12


def test_any_ahead(town2):
    env = TownEnv(town2, 4, traffic=1, seed=0)
    env.reset()
    places = torch.tensor([[15.0, 0.0], [14.0, -14.0], [-15.0, 0.0], [26.0, 0.0]])  # ahead, left, behind, far
    env._traffic._path = torch.cat((places, torch.zeros(4, 1)), -1)[:, None, None]
    assert env._traffic.any_ahead(torch.zeros(4, 3), 25.0).tolist() == [True, True, False, False]
    assert env._traffic.any_ahead(torch.tensor([[0.0, 0.0, math.pi]] * 4), 25.0).tolist() == [False, False, True, False]


def test_time_spent_waiting_does_not_count_as_standing(town2, monkeypatch):
    env = TownEnv(town2, 3, traffic=1, seed=0)
    td = env.reset()
    env._state[:, 3] = 0
    for step in range(40):
        waits = torch.tensor([True, False, step < 10])
        monkeypatch.setattr(env._traffic, "any_ahead", lambda pose, distance, waits=waits: waits)
        td[keys.ACTION] = torch.tensor([-1.0, 0.0]).expand(3, 2)
        ended = env.step(td)["next", "terminated"].flatten().tolist()
        assert ended == [False, step >= 29, step >= 39]


def test_episodes_in_traffic_may_take_twice_as_long(town2, episodes):
    some = episodes["town2"][:5]
    alone, among = TownEnv(town2, episodes=some), TownEnv(town2, episodes=some, traffic=5)
    assert (among._limit == 2 * alone._limit).all()


def test_bad_traffic_is_named(town2, episodes):
    for wrong in (-1, 2.5, "3", True):
        with pytest.raises(ValueError, match=f"traffic={wrong!r}: give the number of other cars, an int of 0 or more"):
            TownEnv(town2, 2, traffic=wrong)
    with pytest.raises(
        ValueError, match=r"traffic=500: the streets of 'town2' have room for \d+ other cars; use fewer"
    ):
        TownEnv(town2, 2, traffic=500)
    with pytest.raises(ValueError, match=r"traffic=500: .* room for \d+"):
        TownEnv(town2, episodes=episodes["town2"][:2], traffic=500)


def test_the_most_traffic_that_there_is_room_for(crossing, nobody):
    with pytest.raises(ValueError, match="room for") as error:
        Traffic(crossing, 1, 10**6, torch.Generator(), crossing.points)
    most = int(str(error.value).split("room for ")[1].split()[0])
    env = TownEnv(crossing, 16, traffic=most, seed=0)
    td = env.reset()
    assert touching(td[keys.TRAFFIC][..., :3]) == 0
    assert (td[keys.TRAFFIC][..., :2] - td[keys.POSE][:, None, :2]).norm(dim=-1).min() > 17
    assert steer_clear(env._traffic, 20, nobody(16)).mean() > 20
