"""The usual stack as a whole."""

import re

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import DashCamera, RoadSegmenter, make_env, make_highway_env
from ldrl.language import Tokenizer
from ldrl.modules import AgentConfig, HierarchicalAgent

OBSERVED = (keys.IMAGE, keys.INSTRUCTION_TOKENS, keys.SUBTASK, keys.END_OF_SUBTASK, keys.POSE)


@pytest.mark.parametrize("policy", [None, Expert, HierarchicalAgent])
def test_specs_and_what_is_drawn_for_whom(town2, episodes, policy):
    policy = Expert(town2) if policy is Expert else policy and policy()
    check_env_specs(make_env(town2, 2, policy=policy))
    env = make_env(town2, episodes=episodes["town2"][:3], policy=policy)
    check_env_specs(env)
    td = env.reset()
    assert (keys.IMAGE in td.keys(True)) == (not isinstance(policy, Expert))
    assert (keys.VOTES in td.keys(True)) == isinstance(policy, HierarchicalAgent)


def test_roaming_cars_hear_training_sentences(town2):
    env = make_env(town2, num_cars=4, max_steps=6)
    assert env.batch_size == (4,)
    rollout = env.rollout(20, Expert(town2))
    assert rollout.shape == (4, 6)
    assert rollout["next", "truncated"][:, -1].all()


def test_episodes_bring_their_instructions(town2, episodes):
    some = episodes["town2"][3:40:6]
    td = make_env(town2, episodes=some).reset()
    assert torch.equal(td[keys.INSTRUCTION_TOKENS], Tokenizer()([episode.instruction for episode in some]))
    torch.testing.assert_close(td[keys.POSE], torch.tensor([episode.start for episode in some]))
    assert torch.equal(td[keys.IMAGE], DashCamera(town2).draw(td[keys.POSE]))


def test_same_seed_same_rollout_and_a_batch_row_alone(town2, episodes):
    def rollout(seed, episodes=None):
        env = make_env(town2, None if episodes else 4, episodes=episodes, max_steps=15, seed=seed)
        return env.rollout(30, Expert(town2), break_when_any_done=False)

    first, again, other = rollout(0), rollout(0), rollout(1)
    for key in OBSERVED:
        assert torch.equal(first[key], again[key])
        assert key in (keys.SUBTASK, keys.END_OF_SUBTASK) or not torch.equal(first[key], other[key])
    some = episodes["town2"][10:13]
    together, alone = rollout(0, some), rollout(0, some[1:2])
    for key in OBSERVED:
        assert torch.equal(together[key][1], alone[key][0])


def test_traffic(town2):
    env = make_env(town2, 2, traffic=3)
    check_env_specs(env)
    assert env.reset()[keys.TRAFFIC].shape == (2, 3, 4)


def test_town_by_name():
    env = make_env("town2", num_cars=1)
    assert env.base_env.town.name == "town2"
    with pytest.raises(ValueError, match=r"'atlantis'.*town1, town2"):
        make_env("atlantis", num_cars=1)


@pytest.mark.parametrize(("modality", "channels"), [("gs", 1), ("ps", 1), ("rgb", 3)])
def test_a_policy_sees_what_it_is_made_for(town2, modality, channels):
    agent = HierarchicalAgent(AgentConfig(modality=modality, conv_channels=(2, 3, 4)))
    for env in (make_env(town2, 1, policy=agent), make_highway_env(town2, policy=agent)):
        assert env.reset()[keys.IMAGE].shape[-3] == channels
        assert any(isinstance(module, RoadSegmenter) for module in env.transform.modules()) == (modality == "ps")
    assert make_env(town2, 1, policy=agent, modality="rgb").reset()[keys.IMAGE].shape[-3] == 3


@pytest.mark.parametrize("modality", ["gs", "rgb"])
@pytest.mark.parametrize("world", ["town", "highway"])
def test_other_cars_are_in_the_picture(town2, world, modality):
    if world == "town":
        env = make_env(town2, 1, traffic=20, modality=modality, seed=1)
    else:
        env = make_highway_env(town2, config={"vehicles_count": 20}, modality=modality, seed=1)
    images = env.rollout(60, Expert(town2), break_when_any_done=False)
    camera = DashCamera(town2, modality=modality)
    assert torch.equal(images[keys.IMAGE], camera.draw(images[keys.POSE], images[keys.TRAFFIC]))
    empty = camera.draw(images[keys.POSE])
    differs = (images[keys.IMAGE] != empty).flatten(-3).any(-1)
    assert differs.any()
    if modality == "gs":
        assert (images[keys.IMAGE] <= empty).all()  # cars only hide


def test_weights_of_the_segmenter_from_a_folder(town2, tmp_path):
    with pytest.raises(ValueError, match=re.escape(str(tmp_path))):
        make_env(town2, 2, modality="ps", segmenter=tmp_path)


def test_a_segmenter_of_ones_own_in_several_envs(town2):
    segmenter = RoadSegmenter(road="background")
    shipped, *own = (
        make_env(town2, 2, modality="ps", segmenter=given) for given in ("road-segmenter", segmenter, segmenter)
    )
    road, *other = (env.reset()[keys.IMAGE][..., 44:, :] for env in (shipped, *own))
    assert 0 < (road == 255).float().mean() < 1
    assert all(torch.equal(255 - road, images) for images in other)
    assert segmenter.parent is None


def test_appearance_per_episode(town2):
    env, again = (make_env(town2, 3, modality="rgb", appearance="episode", seed=5) for _ in range(2))
    td = env.reset()
    assert td[keys.IMAGE].shape == (3, 3, 88, 200)
    assert torch.equal(td[keys.APPEARANCE], again.reset()[keys.APPEARANCE])
    check_env_specs(env)
