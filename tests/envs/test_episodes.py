"""Episodes: the built-in ones, files there and back, and every way in which a file can be broken."""

import json
import math
from collections import Counter
from dataclasses import replace
from typing import get_args

import pytest

from ldrl.envs import Episode, builtin_episodes, load_episodes, save_episodes
from ldrl.language import KEYWORDS, Family, Sentences
from ldrl.subtasks import SubTask
from ldrl.towns import Town, plan_routes

LINE = {
    "id": "a",
    "town": "town1",
    "keyword": "left",
    "instruction": "turn left",
    "start": [40.0, 2.0, 0.0],
    "path": [[40.0, 2.0], [45.0, 2]],
}


def write(tmp_path, *lines):
    path = tmp_path / "episodes.jsonl"
    path.write_text("".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines), "utf-8")
    return path


def test_builtin_episodes_cover_the_planner(town, episodes):
    count = Counter(episode.keyword for episode in episodes[town.name])
    assert count == {name: len(plan_routes(town, keyword)) for name, keyword in KEYWORDS.items()}
    assert len({episode.id for episode in episodes[town.name]}) == len(episodes[town.name])
    assert {episode.town for episode in episodes[town.name]} == {town.name}


def test_builtin_episodes_start_and_end_where_they_should(town, episodes):
    before = []
    for episode in episodes[town.name]:
        route = episode.route(town)
        junction = float(town.lane_length[route.lanes[0]]) - route.start
        assert 0 <= junction <= 35
        assert town.lane_to_junction[route.lanes[0]] == 0
        assert town.lane_manoeuvre[route.lanes[-2]] == route.manoeuvres[-1]
        assert town.lane_manoeuvre[route.lanes[-1]] == SubTask.LANEFOLLOW
        assert 5 - 0.1 <= route.end <= 10 + 0.1
        gaps = [math.dist(a, b) for a, b in zip(episode.path, episode.path[1:], strict=False)]
        assert max(gaps) <= 1.02
        assert math.dist(episode.path[0], episode.start[:2]) < 0.02
        assert episode.instruction in set(Sentences("heldout").all(episode.keyword))
        before.append(junction)
    assert min(before) < 3
    assert max(before) > 32


def test_builtin_episodes_are_seeded(town2, episodes):
    assert builtin_episodes(town2) == episodes["town2"]
    other = builtin_episodes(town2, seed=1)
    assert [e.id for e in other] == [e.id for e in episodes["town2"]]
    assert other != episodes["town2"]
    trained = builtin_episodes(town2, "train")
    assert all(e.instruction in set(Sentences("train").all(e.keyword)) for e in trained[:20])


def test_builtin_episodes_stay_as_they_were(episodes):
    """Reports are compared over the years, so the set is fixed; each episode depends on all draws before it."""
    assert {town: len(some) for town, some in episodes.items()} == {"town1": 272, "town2": 178}
    first, last = episodes["town2"][0], episodes["town2"][-1]
    assert first.start == pytest.approx((20.165, 187.59, 3.142))
    assert last.start == pytest.approx((189.69, 210.383, 1.571))
    assert last.instruction == "uh we need to drive down the road and take the second possible right"
    assert episodes["town1"][-1].start == pytest.approx((334.82, 157.565, 1.571))
    assert episodes["town1"][-1].instruction == "well second street to the right thanks"


@pytest.mark.parametrize("split", ["train", *get_args(Family)])
def test_other_splits_say_something_else_on_the_same_routes(town2, episodes, split):
    others = builtin_episodes(town2, split)
    pairs = list(zip(others, episodes["town2"], strict=True))
    assert all(replace(other, instruction="same") == replace(clean, instruction="same") for other, clean in pairs)
    assert all(other.instruction != clean.instruction for other, clean in pairs)
    assert builtin_episodes(town2, split) == others
    assert [e.instruction for e in builtin_episodes(town2, split, seed=1)] != [e.instruction for e in others]


def test_an_unknown_split_is_refused(town2):
    with pytest.raises(ValueError, match="unknown family 'test': use one of paraphrase, "):
        builtin_episodes(town2, "test")


def test_of_many_routes_some_are_drawn(town2, episodes):
    drawn, other = builtin_episodes(town2, most_routes=5), builtin_episodes(town2, seed=1, most_routes=5)
    routes = {episode.id: episode.route(town2).lanes for episode in episodes["town2"]}
    assert set(Counter(episode.keyword for episode in drawn).values()) == {5}
    assert all(episode.route(town2).lanes == routes[episode.id] for episode in drawn)
    assert builtin_episodes(town2, most_routes=5) == drawn
    assert {episode.id for episode in other} != {episode.id for episode in drawn}


def test_there_and_back(tmp_path, episodes):
    save_episodes(episodes["town2"], tmp_path / "episodes.jsonl")
    loaded = load_episodes(tmp_path / "episodes.jsonl")
    assert loaded == episodes["town2"]
    first = json.loads((tmp_path / "episodes.jsonl").read_text("utf-8").splitlines()[0])
    assert list(first) == ["id", "town", "keyword", "instruction", "start", "path"]


def test_random_towns_are_made_when_they_are_named(tmp_path):
    episodes = builtin_episodes(Town.load("random-7-4"), most_routes=1)
    save_episodes(episodes, tmp_path / "e.jsonl")
    towns = {}
    assert load_episodes(tmp_path / "e.jsonl", towns) == episodes
    assert towns.keys() == {"random-7-4"}


def test_stops_are_said_and_nothing_else(tmp_path):
    stops, drives = Episode(**LINE, stop=True), Episode(**LINE)
    save_episodes([stops, drives], tmp_path / "episodes.jsonl")
    assert [("stop" in line) for line in (tmp_path / "episodes.jsonl").read_text("utf-8").splitlines()] == [True, False]
    assert load_episodes(tmp_path / "episodes.jsonl") == [stops, drives]
    assert not load_episodes(write(tmp_path, {**LINE, "stop": False}))[0].stop


@pytest.mark.parametrize(
    "name", ["", " a ", "é 🚗\n\t\"'\\", "\u2028\u2029\x85\x0c\x1c", "\ud800", "0", "x" * 10_000, "../../etc", "null"]
)
def test_any_string_is_an_id(tmp_path, name):
    save_episodes([Episode(**{**LINE, "id": name})], tmp_path / "episodes.jsonl")
    assert load_episodes(tmp_path / "episodes.jsonl")[0].id == name


def test_raw_separators_in_strings(tmp_path):
    """JSON allows them unescaped, and other programs write them so."""
    path = write(tmp_path, json.dumps({**LINE, "id": "a\u2028b\x85c"}, ensure_ascii=False), LINE)
    assert [episode.id for episode in load_episodes(path)] == ["a\u2028b\x85c", "a"]


def test_order_blank_lines_and_other_fields(tmp_path):
    lines = [{**LINE, "id": str(k), "note": "ignored"} for k in (3, 1, 2, 1)]
    path = write(tmp_path, lines[0], "", "  ", *lines[1:])
    assert [episode.id for episode in load_episodes(path)] == ["3", "1", "2", "1"]
    path.write_text("\r\n".join(map(json.dumps, lines)), "utf-8")
    assert [episode.id for episode in load_episodes(path)] == ["3", "1", "2", "1"]


def test_keywords_in_any_spelling(tmp_path):
    loaded = load_episodes(write(tmp_path, {**LINE, "keyword": "(Second, left)"}))
    assert loaded[0].keyword == "second left"


@pytest.mark.parametrize("instruction", ["word " * 5000, "🚗 ⬅️", "qwertz", "Links abbiegen, bitte!", "左"])
def test_odd_instructions_are_no_errors(tmp_path, instruction):
    assert load_episodes(write(tmp_path, {**LINE, "instruction": instruction}))[0].instruction == instruction


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"id": "a", "town"', "not JSON .*; write one object with id, town"),
        ("[1, 2]", ".* is no object; write one with id"),
        ("null", ".* is no object"),
        ({k: v for k, v in LINE.items() if k not in ("start", "path")}, "start, path missing; an episode has id, town"),
        ({**LINE, "id": 5}, "id is 5; make it a string"),
        ({**LINE, "id": None}, "id is None; make it a string"),
        ({**LINE, "town": ["town1"]}, r"town is \['town1'\]; make it a string"),
        ({**LINE, "town": "town9"}, "unknown town 'town9'; use one of town1, town2"),
        ({**LINE, "keyword": "third left"}, "unknown keyword 'third left': use one of 'left', "),
        ({**LINE, "keyword": ""}, "unknown keyword ''"),
        ({**LINE, "instruction": ""}, "the instruction '' has no word: say what to do"),
        ({**LINE, "instruction": " ?! "}, "the instruction ' .! ' has no word"),
        ({**LINE, "start": [1, 2]}, r"start is \[1, 2\]; give 3 finite numbers"),
        ({**LINE, "start": "1 2 3"}, "start is '1 2 3'; give 3 finite numbers"),
        ({**LINE, "start": [1, 2, math.nan]}, r"start is \[1, 2, nan\]; give 3 finite numbers"),
        ({**LINE, "start": [1, -math.inf, 3]}, "start is .*-inf.*; give 3 finite numbers"),
        ({**LINE, "start": [1, True, 3]}, "start is .*True.*; give 3 finite numbers"),
        ({**LINE, "start": [10**400, 2, 3]}, "start is .*; give 3 finite numbers"),
        ({**LINE, "path": []}, r"path is \[\]; give at least one point \[x, y\]"),
        ({**LINE, "path": None}, "path is None; give at least one point"),
        ({**LINE, "path": [[1, 2], [1, 2, 3]]}, r"path point 1 is \[1, 2, 3\]; give 2 finite numbers"),
        ({**LINE, "path": [[1, 2], [math.nan, 2]]}, r"path point 1 is \[nan, 2\]; give 2 finite numbers"),
        ({**LINE, "path": [1, 2]}, "path point 0 is 1; give 2 finite numbers"),
        ({**LINE, "stop": "yes"}, "stop is 'yes'; make it true or false"),
        ({**LINE, "start": [40, 30, 0]}, "episode 'a': start .* is 2.* m from the nearest lane of 'town1'; move it"),
        ({**LINE, "start": [40, 2, 3.1]}, "episode 'a': start .* faces against its lane"),
        ({**LINE, "path": [[45, 2], [50, 20]]}, "episode 'a': path point 1 .* is 1.* m from the nearest lane"),
    ],
)
def test_broken_lines_are_named(tmp_path, towns, line, message):
    path = write(tmp_path, LINE, "", line, LINE)
    with pytest.raises(ValueError, match=rf"episodes\.jsonl, line 3: {message}"):
        load_episodes(path, towns)


def test_broken_files_are_named(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"no episode file '.*none\.jsonl'; give a JSON-lines file or 'builtin'"
    ):
        load_episodes(tmp_path / "none.jsonl")
    with pytest.raises(FileNotFoundError, match="no episode file"):
        load_episodes(tmp_path)
    with pytest.raises(ValueError, match=r"episodes\.jsonl has no episode; write one JSON object with id"):
        load_episodes(write(tmp_path, "", " "))
    (tmp_path / "latin.jsonl").write_bytes(json.dumps(LINE).encode() + b"\xe9\n")
    with pytest.raises(ValueError, match=r"latin\.jsonl is not UTF-8 .*; write JSON lines in UTF-8"):
        load_episodes(tmp_path / "latin.jsonl")


def test_routes_off_the_map_are_named(town1, town2, episodes):
    episode = episodes["town1"][0]
    with pytest.raises(ValueError, match=rf"episode '{episode.id}' is set in 'town1', not in 'town2'; split them"):
        episode.route(town2)
    x, y, heading = episode.start
    fields = {**vars(episode), "id": "odd"}
    with pytest.raises(ValueError, match=r"episode 'odd': start .* m from the nearest lane of 'town1'; move it"):
        Episode(**{**fields, "start": (x + 300, y + 700, heading)}).route(town1)
    with pytest.raises(ValueError, match=r"episode 'odd': start .* faces against its lane"):
        Episode(**{**fields, "start": (x, y, heading + math.pi)}).route(town1)
    with pytest.raises(ValueError, match=r"episode 'odd': path point 2 .* m from the nearest lane"):
        Episode(**{**fields, "path": (*episode.path[:2], (-500.0, 0.0))}).route(town1)
