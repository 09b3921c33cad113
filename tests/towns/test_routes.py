"""The planner against the keywords' own definition, and the matcher against the planner."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest

from ldrl.language import KEYWORDS, realised_by
from ldrl.subtasks import MANOEUVRES, SubTask
from ldrl.towns import Layout, Route, Town, UnrealisableError, match_route, plan_route, plan_routes
from ldrl.towns.layout import Node

L, R, S = SubTask.LEFT, SubTask.RIGHT, SubTask.STRAIGHT


def options_met(route):
    """What each junction on the route offers."""
    town = route.town
    met = [[SubTask(int(town.lane_manoeuvre[j])) for j in town.successors(lane)] for lane in route.lanes[:-1]]
    return [options for options in met if SubTask.LANEFOLLOW not in options]


def is_connected(route):
    return all(b in route.town.successors(a) for a, b in pairwise(route.lanes))


def two_loops():
    """Two loops, joined by a street between two T-junctions: going straight on leads back to the same junction."""
    nodes = {
        "j": Node(0, 0, 6), "e": Node(60, 0, 6), "f": Node(60, -60, 6), "g": Node(-60, -60, 6), "h": Node(-60, 0, 6),
        "k": Node(0, 60, 6), "m": Node(60, 60, 6), "n": Node(60, 120, 6), "o": Node(-60, 120, 6), "p": Node(-60, 60, 6),
    }  # fmt: skip
    streets = (("j", "e", "f", "g", "h", "j"), ("j", "k"), ("k", "m", "n", "o", "p", "k"))
    return Layout("two loops", 4.0, nodes, streets).network()


@pytest.fixture(scope="module")
def loops():
    return Town("loops", two_loops())


@pytest.fixture(scope="module")
def no_left():
    network = two_loops()
    for (start, end, _), lane in network.lanes_dict().items():
        if lane.manoeuvre == L:
            del network.graph[start][end]
    return Town("no left", network)


@pytest.fixture(scope="module")
def ring():
    nodes = {"a": Node(0, 0, 8), "b": Node(60, 0, 8), "c": Node(60, 60, 8), "d": Node(0, 60, 8)}
    return Town("ring", Layout("ring", 4.0, nodes, (("a", "b", "c", "d", "a"),)).network())


@pytest.mark.parametrize("keyword", KEYWORDS.values(), ids=KEYWORDS)
def test_every_route_realises_its_keyword(town, keyword):
    routes = plan_routes(town, keyword)
    for route in routes:
        assert is_connected(route)
        options = options_met(route)
        assert len(options) == len(route.manoeuvres)
        assert keyword in realised_by(route.manoeuvres, options)
        assert route.lanes[0] in town.approaches()
        assert (route.start, route.end) == (0, float(town.lane_length[route.lanes[-1]]))
        assert town.lane_manoeuvre[route.lanes[-2]] == route.manoeuvres[-1]
        assert town.lane_manoeuvre[route.lanes[-1]] == SubTask.LANEFOLLOW
    assert len({route.lanes for route in routes}) == len(routes)


@pytest.mark.parametrize("keyword", KEYWORDS.values(), ids=KEYWORDS)
def test_no_route_is_missing(town, keyword):
    """Every way of up to four junctions from every approach: if it realises the keyword, the planner has it."""
    found = {route.lanes for route in plan_routes(town, keyword) if len(route.manoeuvres) <= 4}
    expected = set()

    def extend(lanes, manoeuvres, options):
        offered = {SubTask(int(town.lane_manoeuvre[lane])): lane for lane in town.successors(lanes[-1])}
        if SubTask.LANEFOLLOW in offered:
            lanes = (*lanes, offered[SubTask.LANEFOLLOW])
            leaves_junction = town.lane_manoeuvre[lanes[-2]] in MANOEUVRES
            if leaves_junction and keyword in realised_by(manoeuvres, options):
                expected.add(lanes)
            elif len(manoeuvres) < 4:
                extend(lanes, manoeuvres, options)
            return
        for manoeuvre, lane in offered.items():
            extend((*lanes, lane), (*manoeuvres, manoeuvre), (*options, set(offered)))

    for approach in town.approaches():
        extend((approach,), (), ())
    assert found == expected


def test_ordinals_count_turns_that_exist(town):
    for name, turn in (("first left", L), ("first right", R), ("second left", L), ("second right", R)):
        nth, passed_others = 1 + name.startswith("second"), 0
        for route in plan_routes(town, KEYWORDS[name]):
            options = options_met(route)
            assert [turn in offered for offered in options].count(True) == nth
            assert turn in options[-1]
            assert route.manoeuvres == (S,) * (len(options) - 1) + (turn,)
            passed_others += len(options) > nth
        assert passed_others or nth == 2  # streets on the other side do not count


def test_planned_from_one_approach_only(town1):
    approach = next(a for a in town1.approaches() if not any(town1.lane_manoeuvre[j] == L for j in town1.successors(a)))
    with pytest.raises(
        UnrealisableError, match=r"'left' meets a junction of 'town1' that offers only (right|straight), "
    ):
        plan_route(town1, KEYWORDS["left"], approach)


def test_a_street_that_the_lane_does_not_lead_into_counts(town1, monkeypatch):
    """The passenger sees it, so "first right" does not mean the right turn at the junction after it."""
    routes = [route for route in plan_routes(town1, KEYWORDS["first right"]) if route.manoeuvres == (S, R)]
    approach, junction = routes[0].lanes[:2]
    # as if there was another lane beside the approach, which turns right where this one does not
    options = [frozenset((L, R, S)) if i == junction else offered for i, offered in enumerate(town1.lane_options)]
    monkeypatch.setattr(town1, "lane_options", options)
    with pytest.raises(UnrealisableError, match=r"'first right' meets a junction .* that offers only"):
        plan_route(town1, KEYWORDS["first right"], approach)
    assert plan_route(town1, KEYWORDS["second right"], approach).lanes == routes[0].lanes


def test_a_keyword_that_a_town_cannot_realise(ring, no_left):
    with pytest.raises(
        UnrealisableError, match=r"'ring' cannot realise 'left' from any of its 0 approaches.*no junction"
    ):
        plan_routes(ring, KEYWORDS["left"])
    message = "'no left' cannot realise 'right,left' from any of its 6 .* meets a junction .* that offers only"
    with pytest.raises(UnrealisableError, match=message):
        plan_routes(no_left, KEYWORDS["right,left"])
    assert plan_routes(no_left, KEYWORDS["right,right"])


def test_a_route_that_loops_forever(loops):
    """From the ring's other side the only street is on the right, so a left never comes."""
    looping = [
        approach
        for approach in loops.approaches()
        if {int(loops.lane_manoeuvre[j]) for j in loops.successors(approach)} == {S, R}
    ]
    assert looping
    for approach in looping:
        with pytest.raises(UnrealisableError, match=rf"'first left' from lane {approach} of 'loops' loops forever"):
            plan_route(loops, KEYWORDS["first left"], approach)
    assert all(route.lanes[0] not in looping for route in plan_routes(loops, KEYWORDS["first left"]))


def test_length_and_poses(town):
    for route in plan_routes(town, KEYWORDS["left,right"])[:4]:
        driven = Route(town, route.lanes, route.start + 3, route.end - 4)
        poses = driven.poses(0.25)
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        assert steps.max() <= 0.25 + 1e-6
        assert steps.sum() == pytest.approx(driven.length, abs=0.05)
        first, last = (town.network.get_lane(town.lane_indices[k]) for k in (route.lanes[0], route.lanes[-1]))
        assert poses[0, :2] == pytest.approx(first.position(3, 0))
        assert poses[-1, :2] == pytest.approx(last.position(route.end - 4, 0), abs=1e-3)
        ahead = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
        assert np.abs(np.angle(np.exp(1j * (ahead - poses[:-1, 2])))).max() < 0.05


def test_matching_inverts_the_planner_for_every_episode(town, episodes):
    for episode in episodes[town.name]:
        route = match_route(town, episode.start, episode.path)
        planned = plan_routes(town, KEYWORDS[episode.keyword])[int(episode.id.rsplit("-", 1)[1])]
        assert route.lanes == planned.lanes, episode.id
        reached = route.poses()[[0, -1], :2]
        assert reached[0] == pytest.approx(episode.start[:2], abs=0.05)
        assert reached[1] == pytest.approx(episode.path[-1], abs=0.05)


@pytest.mark.parametrize(("spacing", "lanes"), [(1.0, 24), (3.0, 24), (10.0, 12)])
def test_matching_finds_any_drive(town, spacing, lanes):
    """Random drives that come by the same places again and again, with inaccurate points."""
    rng, noise = random.Random(0), np.random.default_rng(0)
    for _ in range(20):
        way = [rng.choice(town.approaches())]
        while len(way) < lanes:
            way.append(rng.choice(town.successors(way[-1])))
        while town.lane_manoeuvre[way[-1]] != SubTask.LANEFOLLOW:  # inside a junction the end would be ambiguous
            way.append(rng.choice(town.successors(way[-1])))
        drive = Route(town, tuple(way), rng.uniform(0, float(town.lane_length[way[0]]) - 2), 3.0)
        poses = drive.poses(spacing)
        path = poses[:, :2] + noise.normal(0, 0.3, (len(poses), 2))
        route = match_route(town, poses[0], path.tolist())
        assert route.lanes == drive.lanes
        assert (route.start, route.end) == pytest.approx((drive.start, drive.end), abs=1.2)


def test_matching_a_path_of_one_point(town1):
    planned = plan_routes(town1, KEYWORDS["left"])[0]
    drive = Route(town1, planned.lanes, float(town1.lane_length[planned.lanes[0]]) - 10, 6.0)
    poses = drive.poses()
    assert match_route(town1, poses[0], [poses[-1, :2].tolist()]).lanes == planned.lanes


def along_street(town, first=10.0, last=40.0):
    lane = max(town.approaches(), key=lambda k: float(town.lane_length[k]))
    return Route(town, (lane,), first, last).poses()


def test_bad_starts_are_named(town):
    poses = along_street(town)
    path = poses[:, :2].tolist()
    x, y, heading = poses[0].tolist()
    with pytest.raises(ValueError, match=rf"start \[9999\.0, .* m from the nearest lane of '{town.name}'; move it"):
        match_route(town, (9999.0, y, heading), path)
    beside = (x + 40 * math.sin(heading), y - 40 * math.cos(heading), heading)
    with pytest.raises(ValueError, match=r"start .* m from the nearest lane"):
        match_route(town, beside, path)
    for turn in (math.pi, 1.7):
        with pytest.raises(ValueError, match=r"start .* faces against its lane .*; turn its heading \(rad\) around"):
            match_route(town, (x, y, heading + turn), path)
    for turn in (2 * math.pi, -4 * math.pi, 1.0, -1.0):
        assert match_route(town, (x, y, heading + turn), path).length == pytest.approx(30, abs=0.1)


def test_bad_paths_are_named(town):
    poses = along_street(town)
    path = poses[:, :2].tolist()
    side = 30 * np.array((math.sin(poses[0, 2]), -math.cos(poses[0, 2])))
    with pytest.raises(ValueError, match=r"path point 7 \[.* is .* m from the nearest lane"):
        match_route(town, poses[0], [*path[:7], (path[7] + side).tolist(), *path[8:]])
    with pytest.raises(ValueError, match=r"path point 3 \[1000000000000\.0, 0\.0\] is .* m from the nearest lane"):
        match_route(town, poses[0], [*path[:3], [1e12, 0.0]])
    with pytest.raises(ValueError, match=r"path point 15 .* is on no lane .* leads on .* driving order"):
        match_route(town, poses[0], [*path[:20:2], *path[20:25], *path[5:8]])
