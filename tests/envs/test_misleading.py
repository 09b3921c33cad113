"""Misleading routes against a walk through the town by hand, and the episodes on them."""

import math
from collections import Counter

import pytest
import torch

from ldrl import keys
from ldrl.collectors import Expert, evaluate
from ldrl.envs import TownEnv, load_episodes, misleading_episodes, save_episodes
from ldrl.envs.misleading import misleading_routes
from ldrl.language import KEYWORDS, SAFE_KEYWORDS, Sentences
from ldrl.subtasks import SubTask
from ldrl.towns import Layout, Town
from ldrl.towns.layout import Node

L, R, S = SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT


@pytest.fixture(scope="module")
def misleading(towns):
    return {name: misleading_episodes(town) for name, town in towns.items()}


def walk(town, keyword, approach):
    """Lane by lane, by the paper's rule: whether the car was misled, whether it stops, and its lanes."""
    lanes, misled = [approach], False
    for asked in keyword.manoeuvres:
        while len(following := town.successors(lanes[-1])) == 1:
            lanes += following
        offered = {int(town.lane_manoeuvre[lane]): lane for lane in following}
        misled |= asked not in offered
        if asked not in offered and S not in offered:
            return misled, True, tuple(lanes)
        lanes.append(offered[asked if asked in offered else S])
    return misled, False, (*lanes, *town.successors(lanes[-1]))


@pytest.mark.parametrize("name", SAFE_KEYWORDS)
def test_routes_are_a_walk_by_the_rule(town, name):
    expected = {walk(town, KEYWORDS[name], approach) for approach in town.approaches()}
    expected = {(stops, lanes) for misled, stops, lanes in expected if misled}
    found = misleading_routes(town, name)
    assert {(route.stops, route.lanes) for route in found} == expected
    assert len(found) == len(expected) > 0
    for route in found:
        assert (route.start, route.end) == (0, float(town.lane_length[route.lanes[-1]]))


def test_what_is_driven_by_hand(town):
    driven = {name: {(route.manoeuvres, route.stops) for route in misleading_routes(town, name)} for name in KEYWORDS
              if KEYWORDS[name].type != "ordinal"}  # fmt: skip
    assert driven["left"] == {((S,), False)}
    assert driven["straight"] == {((), True)}
    assert driven["straight,straight"] == {((), True), ((S,), True)}
    # first impossible, second impossible, both
    assert driven["left,left"] == {((S, L), False), ((L, S), False), ((S, S), False)}
    assert driven["right,straight"] == {((S, S), False), ((R,), True), ((S,), True)}


def test_ordinals_do_not_mislead(town2):
    with pytest.raises(ValueError, match=r"'second left' is an ordinal and never misleads; use one of 'left', 'right'"):
        misleading_routes(town2, "second left")


def test_no_route_where_all_is_allowed():
    nodes = {"a": Node(0, 0, 8), "b": Node(60, 0, 8), "c": Node(60, 60, 8), "d": Node(0, 60, 8)}
    ring = Town("ring", Layout("ring", 4.0, nodes, (("a", "b", "c", "d", "a"),)).network())
    assert misleading_episodes(ring) == []


def test_episodes_cover_the_routes(town, misleading):
    some = misleading[town.name]
    routes = {name: misleading_routes(town, name) for name in SAFE_KEYWORDS}
    assert Counter(e.keyword for e in some) == {name: len(found) for name, found in routes.items()}
    assert len({e.id for e in some}) == len(some)
    for episode in some:
        name, k = episode.id.removeprefix(f"{town.name}-misleading-").rsplit("-", 1)
        assert name == episode.keyword.replace(",", "-")
        planned, driven = routes[episode.keyword][int(k)], episode.route(town)
        assert driven.lanes == planned.lanes
        assert episode.stop == planned.stops
        assert episode.instruction in set(Sentences("heldout").all(episode.keyword))


def test_starts_and_ends(town, misleading):
    at_once = []
    for episode in misleading[town.name]:
        route = episode.route(town)
        before = float(town.lane_length[route.lanes[0]]) - route.start
        behind = float(town.lane_length[route.lanes[-1]]) - route.end
        assert before <= 35.01
        if not episode.stop:
            assert 4.9 <= route.end <= 10.1
            continue
        assert behind == pytest.approx(2.5, abs=0.05)  # half a car
        if not route.manoeuvres:
            at_once.append(before)
    assert 10.5 <= min(at_once) < 15
    assert max(at_once) > 30


def test_seeds_and_many_routes(town2, misleading):
    assert misleading_episodes(town2) == misleading["town2"]
    assert misleading_episodes(town2, seed=1) != misleading["town2"]
    drawn = misleading_episodes(town2, most_routes=5)
    assert set(Counter(episode.keyword for episode in drawn).values()) == {5}
    assert {e.id for e in drawn} < {e.id for e in misleading["town2"]}


def test_there_and_back(tmp_path, towns, misleading):
    save_episodes(misleading["town1"], tmp_path / "episodes.jsonl")
    assert load_episodes(tmp_path / "episodes.jsonl", towns) == misleading["town1"]


def test_the_expert_is_perfect(town, towns, misleading):
    """Where it should stop, it stands within 1.5 m of the path's end."""
    for outcome in evaluate(Expert, misleading[town.name], towns):
        assert outcome.strict_success, outcome.episode.id
        assert not outcome.stuck
        if outcome.episode.stop:
            assert math.dist(outcome.track[-1], outcome.episode.path[-1]) < 1.5
            assert (outcome.track[-1] - outcome.track[-20]).norm() < 0.1


class Onwards(Expert):
    """An expert that never finishes: it turns somewhere."""

    def forward(self, tensordict):
        remaining = tensordict[keys.REMAINING]
        super().forward(tensordict.set(keys.REMAINING, torch.full_like(remaining, math.inf)))
        return tensordict.set(keys.REMAINING, remaining)


def test_a_car_that_drives_on_fails(town, towns, misleading):
    stops = [episode for episode in misleading[town.name] if episode.stop and len(episode.path) < 60][::3]
    for outcome in evaluate(Onwards, stops, towns):
        assert outcome.largest_gap < 2  # it did pass the path
        assert not outcome.collision
        assert not outcome.success
        assert not outcome.strict_success


def test_remaining_is_to_where_the_throttle_is_cut(town2, misleading):
    some = misleading["town2"][::5]
    assert {episode.stop for episode in some} == {True, False}
    remaining = TownEnv(town2, episodes=some).reset()[keys.REMAINING].flatten().tolist()
    for episode, found in zip(some, remaining, strict=True):
        rolls = 4.7**2 / 3 if episode.stop else 0.0
        assert found == pytest.approx(episode.route(town2).length - rolls, abs=1e-3)
