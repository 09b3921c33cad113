"""Towns made of OpenDRIVE maps: names, episodes, and drives on them."""

import json
from pathlib import Path

import pytest
import torch

from ldrl.collectors import Expert, evaluate
from ldrl.envs import Episode, builtin_episodes, load_episodes, save_episodes
from ldrl.envs.labels import route_subtask
from ldrl.subtasks import SubTask
from ldrl.towns import ROUTE_LANES, Town

MAP = Path(__file__).with_name("theta.xodr")


@pytest.fixture(scope="module")
def theta():
    return Town.load(MAP)


def test_the_map_file_is_what_the_tests_write(xodr):
    """It is there for tests outside this folder; ``python -c`` with ``conftest.theta()`` writes it anew."""
    assert MAP.read_text(encoding="utf-8") == xodr.theta()


def test_the_expert_drives_every_episode_strictly(theta):
    episodes = builtin_episodes(theta)
    assert len(episodes) == 44
    assert episodes[0].id == "theta.xodr-left-0"
    assert {episode.town for episode in episodes} == {"theta.xodr"}
    outcomes = evaluate(Expert, episodes, {theta.name: theta})
    assert [outcome.episode.id for outcome in outcomes if not outcome.strict_success] == []


def test_an_episode_file_lies_beside_its_map(theta, tmp_path):
    """Built-in episodes, saved next to the map that they name, are read and driven without naming it again."""
    some = builtin_episodes(theta)[:2]
    (tmp_path / "theta.xodr").write_text(MAP.read_text(encoding="utf-8"), encoding="utf-8")
    save_episodes(some, tmp_path / "mine.jsonl")
    towns = {}
    assert load_episodes(tmp_path / "mine.jsonl", towns) == some
    assert list(towns) == ["theta.xodr"]
    assert towns["theta.xodr"].name == "theta.xodr"
    assert all(outcome.success for outcome in evaluate(Expert, some, towns))


@pytest.mark.parametrize("absolute", [True, False])
def test_an_episode_names_its_map_by_path(absolute, theta, tmp_path):
    (tmp_path / "maps").mkdir()
    (tmp_path / "episodes").mkdir()
    path = tmp_path / "maps" / "theta.xodr"
    path.write_text(MAP.read_text(encoding="utf-8"), encoding="utf-8")
    name = str(path) if absolute else "../maps/theta.xodr"
    episode = Episode(**{**vars(builtin_episodes(theta)[0]), "town": name})
    save_episodes([episode, episode], tmp_path / "episodes" / "mine.jsonl")
    towns = {}
    assert load_episodes(tmp_path / "episodes" / "mine.jsonl", towns)[0].town == name
    assert list(towns) == [name]  # the episodes, the towns and the reports call it the same
    assert towns[name].name == name


def test_bad_maps_of_episodes_are_named_with_the_line(theta, tmp_path):
    episode = vars(builtin_episodes(theta)[0])
    path = tmp_path / "mine.jsonl"
    for name, message in (
        ("none.xodr", "there is no map .*none.xodr'"),
        ("broken.xodr", "map .*broken.xodr is no XML"),
        ("theta.xml", r"unknown town 'theta.xml'; use one of .*, or the path of a \.xodr file"),
    ):
        (tmp_path / "broken.xodr").write_text("<", encoding="utf-8")
        path.write_text(json.dumps({**episode, "town": name}) + "\n", encoding="utf-8")
        with pytest.raises(ValueError, match=rf"mine\.jsonl, line 1: {message}"):
            load_episodes(path, {})


def test_labels_begin_before_the_junction(theta):
    """On the way through a junction: follow, from 6 m before it turn, from its exit follow again."""
    for approach in theta.approaches():
        for turn in theta.successors(approach):
            lanes = [int(theta.lane_predecessor[approach]), approach, turn]
            while len(lanes) < ROUTE_LANES:
                lanes.append(theta.successors(lanes[-1])[0])
            length = theta.lane_length[[approach, turn]].cumsum(0)
            position = torch.stack((length[0] - 6.2, length[0] - 5.8, length[1] - 0.2, length[1] + 0.2))
            labels = route_subtask(theta, torch.tensor([lanes] * 4), position)
            manoeuvre = int(theta.lane_manoeuvre[turn])
            assert labels.tolist() == [SubTask.LANEFOLLOW, manoeuvre, manoeuvre, SubTask.LANEFOLLOW]
