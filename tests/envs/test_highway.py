"""The highway-env environment: Gymnasium's contract, TorchRL's, and agreement with TownEnv."""

import os
import random
import subprocess
import sys
import warnings
from dataclasses import asdict, replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from torchrl.envs import GymWrapper, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

import ldrl  # noqa: F401  registers the environments
from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import HighwayTownEnv, Instruction, TownEnv, make_env, make_highway_env
from ldrl.modules import HierarchicalAgent
from ldrl.modules.checkpoint import load_agent

STRAIGHT_ON = np.array([0.3, 0.0], np.float32)


@pytest.fixture
def env(town2):
    return HighwayTownEnv({"town": town2, "vehicles_count": 5})


def actions(count, seed=0):
    """Bursts of throttle and wandering steer, float32."""
    rng = np.random.default_rng(seed)
    throttle = rng.uniform(0, 0.8, count) * (np.arange(count) // 15 % 3 > 0)
    return np.stack((throttle, np.clip(rng.normal(0, 0.15, count), -1, 1)), -1).astype(np.float32)


def digest(env, seed, steps=20):
    """All that a drive straight on shows, as text."""
    seen = [env.reset(seed=seed)[0]] + [env.step(STRAIGHT_ON)[0] for _ in range(steps)]
    return repr([world["world"]["traffic"].tolist() + world["world"]["pose"].tolist() for world in seen])


@pytest.mark.parametrize("vehicles_count", [0, 3])
def test_gymnasiums_contract(town2, vehicles_count):
    config = {"town": town2, "vehicles_count": vehicles_count}
    env = gymnasium.make("ldrl/Town-v0", render_mode="rgb_array", config=config)
    with warnings.catch_warnings():
        warnings.filterwarnings("error")
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is -?infinity")
        check_env(env.unwrapped)


def test_by_town(town2):
    assert gymnasium.make("ldrl/Town2-v0", config={"vehicles_count": 1}).unwrapped.town.name == "town2"
    env = gymnasium.make("ldrl/Town-v0", config={"town": town2})
    assert env.unwrapped.town is town2
    env.reset(seed=0)
    env.step(STRAIGHT_ON)
    env.reset(options={"config": {"town": "town1", "vehicles_count": 2}})
    assert env.unwrapped.town.name == "town1"
    assert len(env.unwrapped.road.vehicles) == 3


def test_same_seed_same_traffic_in_any_process_and_after_other_envs(env):
    code = (
        "import gymnasium, numpy as np\n"
        "from tests.envs.test_highway import digest\n"
        "env = gymnasium.make('ldrl:ldrl/Town2-v0', config={'vehicles_count': 5}).unwrapped\n"
        "print(digest(env, 7))"
    )
    there = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    printed = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=there).stdout
    here = digest(env, 7)
    assert here == printed.strip()
    busy = HighwayTownEnv({"town": env.town, "vehicles_count": 12, "observation": {"type": "Kinematics"}})
    busy.reset(seed=3)
    np.random.seed(1)
    random.seed(1)
    torch.manual_seed(1)
    busy.step(STRAIGHT_ON)
    assert digest(env, 7) == here
    assert digest(env, 8) != here


def test_global_generators_are_left_alone(env):
    torch.manual_seed(1)
    np.random.seed(1)
    random.seed(1)
    before = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
    digest(env, 0)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()
    assert random.getstate() == before[2]


def test_a_seeded_action_space_stays_seeded(env):
    def sample():
        env.action_space.seed(0)
        env.reset(seed=0)
        return env.action_space.sample()

    assert np.array_equal(sample(), sample())


@pytest.mark.parametrize("kind", ["roaming", "episode"])
def test_same_drive_as_town_env(town2, episodes, kind):
    """The same actions until the drive ends: poses, progress, flags, reward and ends."""
    for seed in range(3):
        episode = None if kind == "roaming" else episodes["town2"][40 * seed]
        env = HighwayTownEnv({"town": town2, "episode": episode, "max_steps": 90})
        twin = TownEnv(town2, None if episode else 1, episodes=episode and [episode], max_steps=90)
        twin.set_seed(int(np_random(seed)[0].integers(2**31)))
        observation, _ = env.reset(seed=seed)
        expected = twin.reset()
        for step, action in enumerate(actions(500, seed)):
            for key in expected.keys(True, True):
                if key[0] == keys.WORLD:
                    row = expected[key][0].numpy()
                    got = observation[keys.WORLD][key[1]]
                    assert got.dtype == row.dtype
                    np.testing.assert_allclose(got, row, rtol=0, atol=1e-4)
            if step and (terminated or truncated):  # noqa: F821
                break
            observation, reward, terminated, truncated, _ = env.step(action)
            expected[keys.ACTION] = torch.from_numpy(action).unsqueeze(0)
            expected = twin.step(expected)["next"]
            assert reward == pytest.approx(expected["reward"].item(), abs=1e-4)
            assert (terminated, truncated) == (expected["terminated"].item(), expected["truncated"].item())
        assert terminated or truncated
        assert step > 30


def test_an_episode_as_a_dictionary(town2, episodes):
    episode = episodes["town2"][5]
    env = HighwayTownEnv({"town": town2, "episode": asdict(episode), "vehicles_count": 4})
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation["world"]["pose"], episode.start, atol=1e-4)
    assert observation["world"]["remaining"][0] == pytest.approx(episode.route(town2).length, abs=1e-3)


def test_the_shipped_agent_drives_the_same_track(town2, episodes):
    agent = load_agent("hierarchical-gs")
    episode = min((e for e in episodes["town2"] if e.keyword == "left"), key=lambda e: len(e.path))
    with torch.no_grad():
        there = make_highway_env(town2, episode=episode, policy=agent).rollout(1000, agent)
        here = make_env(town2, episodes=[episode], policy=agent).rollout(1000, agent)[0]
    assert there.shape == here.shape
    for key in (keys.POSE, keys.PROGRESS, keys.REMAINING):
        torch.testing.assert_close(there["next", key], here["next", key], atol=1e-3, rtol=0)
    assert torch.equal(there[keys.IMAGE], here[keys.IMAGE])
    assert there[keys.AGENT_FINISH].any()
    assert there["next", keys.REMAINING].min() < 5
    assert not there["next", keys.COLLISION].any()


def test_torchrls_contract(town2):
    for count in (0, 3):
        env = GymWrapper(gymnasium.make("ldrl/Town-v0", config={"town": town2, "vehicles_count": count}))
        check_env_specs(env)
        assert env.batch_size == ()
        least = [-1.0 if count else 0.0, -1.0]
        assert env.action_spec.space.low.tolist() == least
        twin = TownEnv(town2, 1, traffic=count).reset()
        td = env.reset()
        for key in twin.keys(True, True):
            assert td[key].dtype == twin[key].dtype, key
            assert td[key].shape == twin[key].shape[1:], key
        assert set(map(str, td.keys(True, True))) == set(map(str, twin.keys(True, True)))
    assert td[keys.TRAFFIC].shape == (3, 4)
    assert td[keys.TRAFFIC].dtype == torch.float32
    assert td[keys.TRAFFIC].isfinite().all()


@pytest.mark.parametrize("policy", [None, Expert, HierarchicalAgent])
def test_the_usual_stack(town2, episodes, policy):
    policy = Expert(town2) if policy is Expert else policy and policy().eval()
    for episode in (None, episodes["town2"][3]):
        env = make_highway_env(town2, episode=episode, policy=policy, config={"vehicles_count": 2})
        check_env_specs(env)
        with torch.no_grad():
            rollout = env.rollout(4, policy)
        given = {"episodes": [episode]} if episode else {"num_cars": 1}
        expected = make_env(town2, **given, policy=policy, traffic=2).rollout(4, policy)
        names = set(map(str, rollout.keys(True, True)))
        assert names == set(map(str, expected.keys(True, True)))
        for key in expected.keys(True, True):
            assert rollout[key].shape == expected[key].shape[1:], key
            assert rollout[key].dtype == expected[key].dtype, key


def test_the_instruction_as_text(town2):
    env = TransformedEnv(GymWrapper(HighwayTownEnv({"town": town2})), Instruction(["turn left"], text=True))
    assert env.reset()[keys.INSTRUCTION] == "turn left"
    assert env.rollout(2)[-1]["next", keys.INSTRUCTION] == "turn left"


def test_side_by_side(town2):
    env = SerialEnv(2, lambda: make_highway_env(town2, config={"vehicles_count": 2}))
    assert env.rollout(3)[keys.IMAGE].shape == (2, 3, 1, 88, 200)


@pytest.mark.parametrize("vehicles_count", [0, 20])
def test_the_expert_drives_episodes(town2, episodes, vehicles_count):
    expert = Expert(town2)
    for episode in episodes["town2"][60:150:30]:
        env = make_highway_env(town2, episode=episode, policy=expert, config={"vehicles_count": vehicles_count})
        rollout = env.rollout(1000, expert)
        assert rollout["next", keys.REMAINING].min() < 1
        assert not rollout["next", keys.OFF_ROAD].any()
        assert not rollout["next", keys.COLLISION].any()


def test_traffic_is_where_the_cars_are(env):
    for step in range(5):
        observation = env.step(STRAIGHT_ON)[0] if step else env.reset(seed=0)[0]
        expected = [[*car.position, car.heading, car.speed] for car in env.road.vehicles if car is not env.vehicle]
        np.testing.assert_allclose(observation["world"]["traffic"], expected, rtol=1e-6)
    env.road.vehicles.pop()
    traffic = env.step(STRAIGHT_ON)[0]["world"]["traffic"]
    assert np.isnan(traffic[4]).all()
    assert np.isfinite(traffic[:4]).all()


def test_running_into_a_car_ends_the_drive(env):
    env.reset(seed=0)
    x, y, heading = env.vehicle.position[0], env.vehicle.position[1], env.vehicle.heading
    del env.road.vehicles[1:]
    ahead = [x + 9 * np.cos(heading), y + 9 * np.sin(heading)]
    env.road.vehicles.append(Vehicle(env.road, ahead, heading, 0.0))
    for _ in range(20):
        observation, _, terminated, truncated, info = env.step(np.array([0.5, 0.0], np.float32))
        collided = bool(observation["world"]["collision"][0])
        assert terminated == collided == info["crashed"]
        if terminated:
            break
    assert terminated
    assert not truncated
    gap = np.hypot(*(env.vehicle.position - ahead))
    assert gap < 5.5
    env.reset(seed=0)
    assert not env.step(STRAIGHT_ON)[2]


def test_negative_throttle_brakes_only_with_traffic(town2):
    speeds = []
    for count in (0, 1):
        env = HighwayTownEnv({"town": town2, "vehicles_count": count})
        env.reset(seed=0)
        for _ in range(3):
            observation = env.step(np.array([-1.0, 0.0], np.float32))[0]
        speeds.append(observation["world"]["speed"][0])
    assert speeds[0] == pytest.approx(4.7 - 3 * 0.15)
    assert speeds[1] < speeds[0] - 0.5


@pytest.mark.parametrize("kind", ["Kinematics", "LidarObservation", "OccupancyGrid", "TupleObservation"])
def test_highway_envs_observations(town2, kind):
    observation = {"type": kind}
    if kind == "TupleObservation":
        observation["observation_configs"] = [{"type": "Kinematics"}, {"type": "LidarObservation"}]
    env = HighwayTownEnv({"town": town2, "vehicles_count": 5, "observation": observation})
    assert env.reset(seed=0)[0] in env.observation_space
    seen, reward, *_ = env.step(STRAIGHT_ON)
    assert seen in env.observation_space
    assert reward == pytest.approx(0.47, abs=0.01)  # m in the first step at 4.7 m/s


@pytest.mark.parametrize("kind", ["ContinuousAction", "DiscreteAction", "DiscreteMetaAction"])
def test_highway_envs_actions(town2, kind):
    env = HighwayTownEnv({"town": town2, "vehicles_count": 2, "action": {"type": kind}})
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
    assert observation["world"]["progress"][0] > 1


def test_highway_envs_traffic(town2):
    env = HighwayTownEnv(
        {"town": town2, "vehicles_count": 4, "other_vehicles_type": "highway_env.vehicle.behavior.IDMVehicle"}
    )
    env.reset(seed=0)
    env.step(STRAIGHT_ON)
    assert all(type(car) is IDMVehicle for car in env.road.vehicles[1:])


@pytest.mark.parametrize("driver", [None, "dummy"])
def test_pictures_without_a_display(town2, monkeypatch, driver):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    if driver is not None:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    grey = {"type": "GrayscaleObservation", "observation_shape": (60, 50), "stack_size": 2, "weights": [0.3, 0.6, 0.1]}
    env = HighwayTownEnv({"town": town2, "vehicles_count": 40, "observation": grey}, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert np.ptp(observation[-1]) > 50
    frame = env.render()
    assert frame.shape == (600, 600, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) >= 4  # ground, lines, the car, other cars
    assert np.array_equal(frame, env.render())
    env.step(STRAIGHT_ON)
    assert not np.array_equal(frame, env.render())
    env.close()


def test_twice_the_simulation_frequency(town2):
    """The car moves in smaller steps, decisions stay at 10 Hz."""
    env = HighwayTownEnv({"town": town2, "simulation_frequency": 20})
    env.reset(seed=0)
    seen = [env.step(STRAIGHT_ON)[0]["world"]["progress"][0] for _ in range(10)]
    assert seen[-1] == pytest.approx(4.7, abs=0.01)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"town": "atlantis"}, r"'atlantis'.*town1, town2"),
        ({"town": 3}, "town is 3; give a Town or the name of one"),
        ({"vehicles_count": -1}, "vehicles_count=-1; give a whole number from 0"),
        ({"vehicles_count": 2.5}, "vehicles_count=2.5; give a whole number from 0"),
        ({"vehicles_count": 4000}, r"vehicles_count=4000, but only \d+ cars fit"),
        ({"max_steps": 0}, "max_steps=0; give a whole number from 1"),
        ({"vehicle_count": 2}, r"unknown settings \['vehicle_count'\]; there are"),
        ({"episode": "left"}, "episode is 'left'; give an Episode, a dictionary of its fields, or None"),
        ({"episode": {"id": "x"}}, "episode has id; an episode has id, town, keyword, instruction, start, path"),
        ({"policy_frequency": 5}, "policy_frequency=5, simulation_frequency=10; the car decides at 10 Hz"),
        ({"observation": "Town"}, "observation is 'Town'; give a dictionary with a type"),
        ({"observation": {"type": "Telepathy"}}, "Unknown observation type"),
        ({"action": {}}, "action is {}; give a dictionary with a type"),
    ],
)
def test_bad_settings_are_named(town2, config, message):
    with pytest.raises(ValueError, match=message):
        HighwayTownEnv({"town": town2} | config)


def test_episodes_of_other_towns_are_refused(town2, episodes):
    with pytest.raises(ValueError, match="is set in 'town1', not in 'town2'"):
        HighwayTownEnv({"town": town2, "episode": episodes["town1"][0]})
    lost = replace(episodes["town2"][1], id="lost", start=(5000.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"episode 'lost': start \[5000.0, 0.0, 0.0\]"):
        HighwayTownEnv({"town": town2, "episode": lost})
