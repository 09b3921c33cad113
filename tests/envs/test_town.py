"""The batched env: against highway-env's own vehicle, against hand-placed cars, and TorchRL's contracts."""

import math
import random
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import TownEnv, vehicle
from ldrl.envs.camera import shift
from ldrl.subtasks import MANOEUVRES, SubTask
from ldrl.towns import Layout, Town
from ldrl.towns.layout import Node

FLAGS = (keys.OFF_ROAD, keys.WRONG_LANE, keys.COLLISION)


@pytest.fixture(scope="module")
def tee():
    """A square of streets 120 m long with a street across its middle: T-junctions at (60, 0) and (60, 120)."""
    nodes = {"a": Node(0, 0, 8), "b": Node(60, 0, 8), "c": Node(120, 0, 8),
             "d": Node(120, 120, 8), "e": Node(60, 120, 8), "f": Node(0, 120, 8)}  # fmt: skip
    return Town("tee", Layout("tee", 4.0, nodes, (("a", "b", "c", "d", "e", "f", "a"), ("b", "e"))).network())


def place(env, pose):
    """Put the env's cars at poses ``[B, 3]`` and observe."""
    env._state[:, :3] = torch.tensor(pose, dtype=torch.float64)
    return env._observe()


def drive(env, action, steps, td=None):
    """Step all cars with one constant action; every step's observations."""
    td = env.reset() if td is None else td
    seen = []
    for _ in range(steps):
        td[keys.ACTION] = torch.tensor(action).expand(*env.batch_size, 2)
        td = env.step(td)["next"]
        seen.append(td.clone())
    return seen


def test_poses_equal_highway_envs_vehicle(town1):
    """500 steps of the same random actions, through the shared throttle map."""
    env = TownEnv(town1, 4, seed=0, max_steps=10**6)
    td = env.reset()
    generator = torch.Generator().manual_seed(0)
    cars = []
    for (x, y, heading), speed in zip(env._state[:, :3].tolist(), env._state[:, 3].tolist(), strict=True):
        cars.append(Vehicle(Road(town1.network), [x, y], heading, speed))
    for step in range(500):
        action = torch.rand(4, 2, generator=generator) * torch.tensor([1.0, 2.0]) - torch.tensor([0.0, 1.0])
        action[:, 0] *= (step // 50) % 2  # rolls to a stop in between
        td[keys.ACTION] = action
        td = env.step(td)["next"]
        for car, (throttle, steer) in zip(cars, action.double(), strict=True):
            acceleration = float(vehicle.acceleration(throttle, torch.tensor(car.speed, dtype=torch.float64)))
            car.act({"steering": float(steer) * vehicle.MAX_STEERING_ANGLE, "acceleration": acceleration})
            car.step(vehicle.TIME_STEP)
        expected = torch.tensor(np.array([[*car.position, car.heading, car.speed] for car in cars]))
        assert (torch.cat((td[keys.POSE], td[keys.SPEED]), -1).double() - expected).abs().max() < 1e-4
        torch.testing.assert_close(env._state, expected, atol=1e-8, rtol=0)
    assert expected[:, 3].max() > 5


def test_specs(town2, episodes):
    for env in (TownEnv(town2, 3, seed=0), TownEnv(town2, episodes=episodes["town2"][:3], seed=0)):
        check_env_specs(env)
        assert env.reset().batch_size == (3,)


def test_actions_outside_are_clipped(town2):
    wild, tame = (drive(TownEnv(town2, 3, seed=0), action, 5)[-1] for action in ([9.0, 4.0], [1.0, 1.0]))
    assert torch.equal(wild[keys.POSE], tame[keys.POSE])


def test_starts_in_lane_at_4_7_metres_per_second(town):
    env = TownEnv(town, 500, seed=0)
    td = env.reset()
    assert td[keys.SPEED].flatten().tolist() == pytest.approx([4.7] * 500)
    assert td[keys.CROSS_TRACK_ERROR].abs().max() < 0.01
    assert not any(td[flag].any() for flag in FLAGS)
    route = td[keys.ROUTE].long()
    assert (town.lane_manoeuvre[route[:, 1]] == SubTask.LANEFOLLOW).all()
    assert all(b in town.successors(a) for row in route.tolist() for a, b in pairwise(row))
    assert len(route[:, 1].unique()) > 0.9 * (town.lane_manoeuvre == SubTask.LANEFOLLOW).sum()


def test_route_progress_and_cross_track_error_along_a_street(tee):
    env = TownEnv(tee, 1, seed=0)
    env.reset()
    lane = tee.lane_indices.index(("f>a:start", "f>a:end", 0))  # northbound: x = 2, from y = 112 to y = 8
    env._route[:] = torch.tensor([int(tee.lane_predecessor[lane]), *[lane] * 5])
    env._position[:] = 20.0
    env._state[:] = torch.tensor([2.5, 92.0, -math.pi / 2, 5.0], dtype=torch.float64)
    before = env._observe()
    assert before[keys.CROSS_TRACK_ERROR].item() == pytest.approx(0.5, abs=1e-3)
    last = drive(env, [0.3, 0.0], 10, before)[-1]
    assert last[keys.ROUTE_POSITION].item() == pytest.approx(25.0, abs=1e-3)
    assert last[keys.PROGRESS].item() == pytest.approx(5.0, abs=1e-3)
    assert last["reward"].item() == pytest.approx(0.5, abs=1e-3)


def test_flags_of_hand_placed_cars_on_a_street(tee):
    """Southbound through the middle: lane centre x = 58, oncoming lane x = 62, road from x = 55.7 to 64.3."""
    south = math.pi / 2
    cases = {  # lateral position of the origin: off_road, wrong_lane, collision; the car is 2 m wide
        58.0: (False, False, False),
        56.8: (False, False, False),
        56.6: (True, False, False),  # its right side at 55.6, the edge at 55.7
        59.1: (False, True, False),  # its left side is in the oncoming lane
        58.9: (False, False, False),
        62.0: (False, True, False),
        63.4: (True, True, False),
        65.6: (True, False, False),  # all of it beyond the lanes
        52.8: (True, False, False),  # its right side at 51.8: on the sidewalk
        52.6: (True, False, True),  # at 51.6: the buildings stand at 51.7
    }
    env = TownEnv(tee, len(cases), seed=0)
    env.reset()
    observed = place(env, [[x, 60.0, south] for x in cases])
    for k, (x, expected) in enumerate(cases.items()):
        assert tuple(bool(observed[flag][k]) for flag in FLAGS) == expected, x
    # the same cars northbound: the lanes change their roles
    observed = place(env, [[120.0 - x, 60.0, -south] for x in cases])
    for k, (x, expected) in enumerate(cases.items()):
        assert tuple(bool(observed[flag][k]) for flag in FLAGS) == expected, x


def test_wrong_lane_takes_two_corners_and_a_street(tee):
    env = TownEnv(tee, 3, seed=0)
    env.reset()
    slanted = place(env, [[59.0, 60.0, math.pi / 2 - 0.1], [59.3, 60.0, math.pi / 2], [62.0, 60.0, -math.pi / 2]])
    assert slanted[keys.WRONG_LANE].flatten().tolist() == [False, True, False]
    junction = place(env, [[60.0, 0.0, heading] for heading in (0.3, 2.0, -2.0)])
    assert not junction[keys.WRONG_LANE].any()
    assert not junction[keys.OFF_ROAD].any()


def test_wrong_lane_is_never_set_in_a_junction(town):
    lane_of = torch.searchsorted(town.lane_first, torch.arange(len(town.points)), right=True) - 1
    manoeuvre = town.lane_manoeuvre[lane_of]
    first, last = town.lane_first[lane_of], town.lane_first[lane_of] + (town.lane_length / town.lane_spacing)[lane_of]
    place_on_lane = torch.arange(len(lane_of))
    middle = ((place_on_lane - first) * town.lane_spacing[lane_of] > 3) & ((last - place_on_lane) > 7)
    inside = (torch.isin(manoeuvre, torch.tensor(MANOEUVRES)) & middle).nonzero().squeeze(-1)
    poses = torch.cat((town.points[inside], town.headings[inside].unsqueeze(-1)), -1)
    env = TownEnv(town, len(inside), seed=0)
    env.reset()
    assert not place(env, poses.tolist())[keys.WRONG_LANE].any()
    # whereas the other way along streets it always is
    street = ((manoeuvre == SubTask.LANEFOLLOW) & middle).nonzero().squeeze(-1)[: len(inside)]
    poses = torch.cat((town.points[street], town.headings[street].unsqueeze(-1)), -1)
    env = TownEnv(town, len(street), seed=0)
    env.reset()
    assert place(env, shift(poses, 0.0, math.pi).tolist())[keys.WRONG_LANE].all()


def test_a_collision_terminates(tee):
    env = TownEnv(tee, 2, seed=0)
    td = env.reset()
    env._state[0] = torch.tensor([57.0, 60.0, math.pi, 5.0], dtype=torch.float64)  # westward, to the buildings
    seen = drive(env, [0.3, 0.0], 12, td)
    td = next(td for td in seen if td[keys.COLLISION][0])
    assert 51.7 - 0.5 < float(td[keys.POSE][0, 0]) - 2.5 < 51.7
    assert torch.equal(td[keys.COLLISION], td["terminated"])
    assert td["terminated"].flatten().tolist() == td["done"].flatten().tolist() == [True, False]
    assert not td["truncated"].any()


def test_standing_for_three_seconds_terminates(town2):
    env = TownEnv(town2, 2, seed=0)
    seen = drive(env, [0.0, 0.0], 80)
    stands = [bool(td[keys.SPEED][0] < 0.1) for td in seen].index(True)
    ended = [bool(td["terminated"][0]) for td in seen].index(True)
    assert ended - stands == 29  # the 30th step below 0.1 m/s
    assert float(seen[stands][keys.POSE][0, 0] - seen[-1][keys.POSE][0, 0]) == pytest.approx(0, abs=0.02)


def test_standing_does_not_add_up_over_stops(town2):
    env = TownEnv(town2, 1, seed=0)
    td = env.reset()
    for _ in range(4):
        for action, steps in (([0.0, 0.0], 20), ([0.2, 0.0], 5)):
            env._state[:, 3] = 0.0
            seen = drive(env, action, steps, td)
            td = seen[-1]
            assert not any(step["done"].any() for step in seen)


def test_truncates_at_the_limit(town2, episodes):
    roaming = TownEnv(town2, 3, seed=0, max_steps=7)
    rollout = roaming.rollout(20, Expert(town2), break_when_any_done=True)
    assert rollout.shape == (3, 7)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "terminated"].any()
    episode = min(episodes["town2"], key=lambda e: len(e.path))
    env = TownEnv(town2, episodes=[episode], seed=0)
    td = env.reset()
    limit = math.ceil((1.5 * episode.route(town2).length / (20 / 3.6) + 15) / 0.1)
    for step in range(1, limit + 1):
        td[keys.ACTION] = Expert(town2)(td)[keys.ACTION]
        td = env.step(td)["next"]
        assert bool(td["truncated"]) == (step >= limit)


def test_same_seed_same_rollout(town2):
    def rollout(seed):
        env = TownEnv(town2, 8, max_steps=30)
        env.set_seed(seed)
        return env.rollout(60, Expert(town2), break_when_any_done=False)

    first, again, other = rollout(5), rollout(5), rollout(6)
    assert (first == again).all()
    assert not torch.equal(first[keys.POSE], other[keys.POSE])
    assert (TownEnv(town2, 8, seed=5).reset() == TownEnv(town2, 8, seed=5).reset()).all()


def test_global_generators_are_left_alone(town2, episodes):
    torch.manual_seed(1)
    np.random.seed(1)
    random.seed(1)
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
    for env in (TownEnv(town2, 4, max_steps=5, seed=0), TownEnv(town2, episodes=episodes["town2"][:4], seed=1)):
        env.set_seed(3)
        env.rollout(12, Expert(town2), break_when_any_done=False)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()
    assert random.getstate() == before[2]


@pytest.mark.parametrize("with_episodes", [False, True])
def test_a_partial_reset_leaves_other_cars_alone(town2, episodes, with_episodes):
    def env():
        some = sorted(episodes["town2"], key=lambda e: -len(e.path))[:6] if with_episodes else None
        return TownEnv(town2, None if with_episodes else 6, episodes=some, seed=0)

    reset, alone = env(), env()
    td, other = reset.reset(), alone.reset()
    expert = Expert(town2)
    for _ in range(120):  # far enough for routes to have moved on
        td, other = reset.step(expert(td))["next"], alone.step(expert(other))["next"]
    mask = torch.tensor([True, False, False, True, False, False])
    td = reset.reset(td.set("_reset", mask.unsqueeze(-1)))
    start = env().reset()
    assert td[keys.PROGRESS][mask].abs().max() == 0
    assert td[keys.SPEED][mask].flatten().tolist() == pytest.approx([4.7, 4.7])
    if with_episodes:
        assert (td.select(*start.keys())[mask] == start[mask]).all()
    for _ in range(150):
        td, other = reset.step(expert(td))["next"], alone.step(expert(other))["next"]
        routes_agree = (td[keys.ROUTE] == other[keys.ROUTE]).all(-1) & ~mask
        # roaming cars' later turns are drawn anew, all that they drive before is the same
        for key in (keys.POSE, keys.SPEED, keys.PROGRESS, "reward", "done"):
            assert torch.equal(td[key][routes_agree], other[key][routes_agree])
        assert torch.equal(routes_agree, ~mask) or not with_episodes


def test_outputs_do_not_change_afterwards(town2):
    """What a step gave out stays as it was when the car is reset or drives on."""
    env = TownEnv(town2, 3, seed=0, max_steps=10)
    td = Expert(town2)(env.reset())
    out = env.step(td)["next"]
    copy = out.clone()
    env.reset(out.clone().set("_reset", torch.tensor([[True], [False], [True]])))
    drive(env, [0.5, 0.3], 3, out.clone())
    assert (out == copy).all()
    rollout = env.rollout(30, Expert(town2), break_when_any_done=False)
    done = rollout["next", "done"]
    assert done.sum() == 9
    assert (rollout["next", keys.PROGRESS][done] > 3).all()


def test_the_step_mask_holds_cars(town2):
    env, alone = TownEnv(town2, 4, seed=0), TownEnv(town2, 4, seed=0)
    td, other = env.reset(), alone.reset()
    moves = torch.tensor([True, False, True, False])
    expert, held = Expert(town2), env._state.clone()
    for _ in range(30):
        td = env._step(expert(td).set("_step", moves.unsqueeze(-1)))
        other = alone.step(expert(other))["next"]
    assert torch.equal(env._state[~moves], held[~moves])
    assert (td[keys.PROGRESS][~moves] == 0).all()
    assert (td["reward"][~moves] == 0).all()
    for key in (keys.POSE, keys.PROGRESS, keys.CROSS_TRACK_ERROR):
        assert torch.equal(td[key][moves], other[key][moves])
    assert env._steps.tolist() == [30, 0, 30, 0]


def test_a_held_car_keeps_its_standing_time(town2):
    env = TownEnv(town2, 2, seed=0)
    td = env.reset()
    env._state[:, 3] = 0.0
    for step in range(30):
        td[keys.ACTION] = torch.zeros(2, 2)
        td = env._step(td.set("_step", torch.tensor([[True], [step != 20]])))
    assert td["terminated"].flatten().tolist() == [True, False]
    td[keys.ACTION] = torch.zeros(2, 2)
    assert env._step(td.set("_step", torch.tensor([[False], [True]])))["terminated"].all()


def test_a_car_that_ends_does_not_disturb_the_others(town2, episodes):
    """A rollout in which cars end at different times: every row is as it is in a run without the others."""
    some = episodes["town2"][40:44]
    expert = Expert(town2)

    def stubborn(td):
        td = expert(td)
        td[keys.ACTION][0, 1:] = 1.0  # the first car of the four leaves the road
        return td

    together = TownEnv(town2, episodes=some, seed=0).rollout(
        300, stubborn, break_when_all_done=True, break_when_any_done=False
    )
    assert together["next", "done"][0].any()
    ended = int(together["next", "done"][0].int().argmax())
    assert ended < 150
    for row in (1, 2, 3):
        alone = TownEnv(town2, episodes=some[row : row + 1], seed=0).rollout(300, expert, break_when_any_done=True)[0]
        length = min(alone.shape[0], together.shape[1], 100)
        assert length > ended
        torch.testing.assert_close(together["next", keys.POSE][row, :length], alone["next", keys.POSE][:length])


def test_episodes_one_per_row_in_order(town2, episodes):
    some = episodes["town2"][::9]
    env = TownEnv(town2, episodes=some, seed=0)
    for _ in range(2):
        td = env.reset()
        expected = torch.tensor([episode.start for episode in some], dtype=torch.float32)
        torch.testing.assert_close(td[keys.POSE], expected)
    lanes = [list(episode.route(town2).lanes) for episode in some]
    for row, route in zip(td[keys.ROUTE][:, 1:].tolist(), lanes, strict=True):
        assert row[: len(route)] == route[:5]
    done = torch.zeros(len(some), dtype=torch.bool)
    reached = [[] for _ in some]
    while not done.all():
        td = env.step(Expert(town2)(td))["next"]
        for k in (~done).nonzero().flatten().tolist():
            lane = int(td[keys.ROUTE][k, 1])
            reached[k] += [lane] if [lane] != reached[k][-1:] else []
        done |= td["done"].squeeze(-1)
    assert all(seen[: len(route)] == route for seen, route in zip(reached, lanes, strict=True))


def test_roaming_with_the_expert_stays_on_the_road(town):
    env = TownEnv(town, 64, seed=0, max_steps=10**6)
    td, expert = env.reset(), Expert(town)
    turns = torch.zeros(5, dtype=torch.long)
    for _ in range(1000):
        td = env.step(expert(td))["next"]
        assert not td[keys.OFF_ROAD].any()
        assert not td[keys.WRONG_LANE].any()
        assert not td["done"].any()
        turns += torch.bincount(town.lane_manoeuvre[td[keys.ROUTE][:, 1].long()], minlength=5)
    assert td[keys.CROSS_TRACK_ERROR].abs().max() < 1
    assert td[keys.PROGRESS].min() > 500
    assert (turns[[0, 1, 2]] > 1000).all()  # every manoeuvre is driven


def test_a_random_policy_leaves_the_road(town2):
    env = TownEnv(town2, 32, seed=0)
    env.action_spec.seed = 0
    td, left = env.reset(), torch.zeros(32, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    for _ in range(300):
        td[keys.ACTION] = torch.rand(32, 2, generator=generator) * torch.tensor([1.0, 2.0]) - torch.tensor([0.0, 1.0])
        td = step_mdp(env.step(td))
        left |= td[keys.OFF_ROAD].squeeze(-1)
    assert left.float().mean() > 0.95


def test_bad_arguments_are_named(town1, town2, episodes):
    with pytest.raises(ValueError, match="num_cars=None: give at least one car, or a list of episodes"):
        TownEnv(town1)
    with pytest.raises(ValueError, match="num_cars=0: give at least one car"):
        TownEnv(town1, 0)
    with pytest.raises(ValueError, match="num_cars=0: give at least one car"):
        TownEnv(town1, episodes=[])
    with pytest.raises(ValueError, match="num_cars=3 but 2 episodes; leave num_cars out"):
        TownEnv(town1, 3, episodes=episodes["town1"][:2])
    with pytest.raises(ValueError, match="episode 'town2-left-0' is set in 'town2', not in 'town1'"):
        TownEnv(town1, episodes=[*episodes["town1"][:2], episodes["town2"][0]])
    lost = replace(episodes["town2"][1], id="lost", start=(5000.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"episode 'lost': start \[5000.0, 0.0, 0.0\] is .* m from the nearest lane"):
        TownEnv(town2, episodes=[episodes["town2"][0], lost])


def test_reset_of_no_row_changes_nothing(town2):
    env = TownEnv(town2, 3, seed=0)
    td = env.reset()
    state = env._state.clone()
    env._reset(TensorDict({"_reset": torch.zeros(3, 1, dtype=torch.bool)}, [3]))
    assert torch.equal(env._state, state)
    assert td.batch_size == (3,)


def test_an_env_stays_on_its_device(town2):
    env = TownEnv(town2, num_cars=2)
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match="the env is on cpu; make it with device='meta' instead"):
        env.to("meta")


def test_a_town_on_another_device_is_a_copy(square):
    assert square.on("cpu") is square
    assert square.on("meta").points.is_meta
    assert not square.points.is_meta
