"""Segments against the planner, and the decisions that are drawn from them."""

import random
from itertools import pairwise

import pytest
import torch
from torchrl.data import TensorDictReplayBuffer

from ldrl import keys
from ldrl.collectors import BoundarySampler, cut_snippets, find_misleading, find_segments, segments
from ldrl.collectors.demonstrations import TRAJECTORY
from ldrl.envs.misleading import misleading_routes
from ldrl.language import KEYWORDS, SAFE_KEYWORDS, Tokenizer
from ldrl.modules import NO_SUBTASK
from ldrl.subtasks import SubTask
from ldrl.towns import UnrealisableError, plan_route, plan_routes

FINISH, FOLLOW = SubTask.FINISH, SubTask.LANEFOLLOW
AROUND = 20
"""Frames: a decision must lie within 11 m of its boundary."""


def planned(town, keyword, approach):
    """The junction lanes of the planner's route, none where there is none."""
    try:
        route = plan_route(town, KEYWORDS[keyword], approach)
    except UnrealisableError:
        return ()
    return tuple(lane for lane in route.lanes if town.lane_manoeuvre[lane] != FOLLOW)


def crossings(town, snippets, lane):
    """For each snippet the junction lane that it crosses, None while following a lane."""
    found = []
    for start, end in zip(snippets.start.tolist(), snippets.end.tolist(), strict=True):
        inside = [k for k in lane[start:end].tolist() if town.lane_manoeuvre[k] != FOLLOW]
        assert len(set(inside)) <= 1
        found.append(inside[0] if inside else None)
    return found


@pytest.mark.parametrize("max_junctions", [1, 2])
def test_segments_are_what_the_planner_would_drive(town2, labels, max_junctions):
    subtask, drive, lane = labels
    snippets = cut_snippets(subtask, drive)
    crossed = crossings(town2, snippets, lane)
    expected = {name: set() for name in KEYWORDS}
    count = len(crossed)
    for first in range(count - 2):
        for last in range(first + 2, min(first + 2 * max_junctions, count - 1) + 1, 2):
            same_drive = snippets.drive_start[first] == snippets.drive_start[last]
            lanes = tuple(crossed[first + 1 : last : 2])
            between = [subtask[snippets.start[k]] for k in range(first, last + 1, 2)]
            if not same_drive or None in lanes or any(s != FOLLOW for s in between):
                continue
            approach = int(town2.lane_predecessor[lanes[0]])
            for name in KEYWORDS:
                if planned(town2, name, approach) == lanes:
                    expected[name].add(tuple(range(first, last + 1)))
    found = find_segments(town2, snippets, lane, max_junctions)
    assert {name: {segment.snippets for segment in some} for name, some in found.items()} == expected
    assert all(len(set(some)) == len(some) for some in found.values())
    assert {len(segment.snippets) for some in found.values() for segment in some} == {
        2 * n + 1 for n in range(1, max_junctions + 1)
    }


def test_every_route_of_the_planner_is_a_segment(town):
    for name, keyword in KEYWORDS.items():
        for route in plan_routes(town, keyword):
            lane = torch.tensor(route.lanes).repeat_interleave(10)
            subtask = town.lane_manoeuvre[lane]
            snippets = cut_snippets(subtask, torch.zeros_like(lane))
            junctions = len(route.manoeuvres)
            whole = tuple(range(2 * junctions + 1))
            for most in (1, 2, 3, 4):
                found = find_segments(town, snippets, lane, most)[name]
                assert (whole in {segment.snippets for segment in found}) == (junctions <= most)


def test_drives_that_end_in_a_manoeuvre_are_no_segments(town2, labels):
    """A segment needs the way to its first manoeuvre and the begin of the way behind its last."""
    subtask, drive, lane = labels
    snippets = cut_snippets(subtask, drive)
    left = int((snippets.subtask == SubTask.LEFT).nonzero()[1])
    for start, end, several in [
        (int(snippets.start[left - 1]), int(snippets.end[left + 1]), True),
        (int(snippets.start[left]), int(snippets.end[left + 1]), False),
        (int(snippets.start[left - 1]), int(snippets.end[left]), False),
    ]:
        part = slice(start, end)
        found = find_segments(town2, cut_snippets(subtask[part], drive[part]), lane[part])
        assert bool(found["left"]) == several


@pytest.fixture
def say(monkeypatch):
    """Lets the passengers say the keyword itself, without drawing anything, or one nonsense word."""

    class Plain:
        tokenizer = Tokenizer()

        def say(self, keyword, rng):
            return keyword.name

        def nonsense(self, rng):
            return "zzyzzyx"

    monkeypatch.setattr(segments, "Passenger", Plain)


@pytest.fixture
def sampled(demonstrations, town2, say):
    sampler = BoundarySampler(demonstrations, town2)
    index, info = sampler.sample(demonstrations.storage, 600 * sampler.decisions)
    shape = (600, sampler.decisions)
    return index.view(shape), {key: value.view(*shape, *value.shape[1:]) for key, value in info.items()}


def sequences(sampled):
    """Keyword, frames, right answers and previous sub-tasks of each sequence, without padding."""
    index, info = sampled
    words = list(Tokenizer().glove.words)
    for frames, mask, target, before, tokens in zip(
        index,
        info["mask"],
        info[keys.SUBTASK],
        info[keys.PREVIOUS_SUBTASK],
        info[keys.INSTRUCTION_TOKENS],
        strict=True,
    ):
        said = " ".join(words[token - 2] for token in tokens[0] if token > 1)
        keyword = next((name for name in KEYWORDS if name.replace(",", " ") == said), None)
        n = int(mask.sum())
        yield keyword, frames[:n].tolist(), target[:n].tolist(), before[:n].tolist()


def test_mask_padding_and_tokens(sampled, demonstrations):
    index, info = sampled
    mask = info["mask"]
    length = mask.sum(1)
    assert torch.equal(mask, torch.arange(mask.shape[1]) < length.unsqueeze(-1))
    assert length.min() >= 1
    assert 5 <= length.max() <= mask.shape[1]
    assert index.min() >= 0
    assert index.max() < len(demonstrations)
    tokens = info[keys.INSTRUCTION_TOKENS]
    assert (tokens == tokens[:, :1]).all()
    assert (tokens[:, 0] != 0).any(1).all()
    # What padding says must be fit for the networks, though it counts for nothing.
    assert info[keys.SUBTASK].max() <= FINISH
    assert info[keys.PREVIOUS_SUBTASK].max() <= NO_SUBTASK


def test_decisions_follow_the_instruction(sampled):
    kinds = []
    for keyword, _, target, before in sequences(sampled):
        assert before == [NO_SUBTASK, *target[:-1]]
        assert target[-1] == FINISH
        assert FINISH not in target[:-1]
        if len(target) == 1:  # nonsense, which only stops
            assert keyword is None
            continue
        kinds.append(keyword)
        manoeuvres = [k for k in target if k not in (FOLLOW, FINISH)]
        # Lane following and manoeuvres by turns; the first decision may already be a manoeuvre.
        assert all((a == FOLLOW) != (b == FOLLOW) for a, b in pairwise(target[:-1]))
        assert target[-2] == manoeuvres[-1]
        if KEYWORDS[keyword].type == "ordinal":
            assert manoeuvres == [SubTask.STRAIGHT] * (len(manoeuvres) - 1) + [KEYWORDS[keyword].manoeuvres[0]]
        else:
            assert manoeuvres == list(KEYWORDS[keyword].manoeuvres)
    nonsense = 1 - len(kinds) / 600
    assert 0 < nonsense < 0.15
    for name in KEYWORDS:
        assert len(kinds) / 14 * 0.45 < kinds.count(name) < len(kinds) / 14 * 1.8, name


def test_decisions_lie_where_they_are_due(sampled, labels):
    subtask, drive, _ = labels
    early = late = on_the_way = 0
    for _, frames, target, before in sequences(sampled):
        assert len({int(drive[frame]) for frame in frames}) == 1
        assert frames == sorted(frames)
        if len(target) == 1:
            continue
        assert subtask[frames[0]] == target[0]
        on_the_way += target[0] == FOLLOW
        for frame, chosen, previous in zip(frames[1:], target[1:], before[1:], strict=True):
            behind = FOLLOW if chosen == FINISH else chosen
            boundaries = [
                k
                for k in range(max(frame - AROUND, 1), min(frame + AROUND, len(subtask) - 1) + 1)
                if subtask[k - 1] == previous and subtask[k] == behind and drive[k - 1] == drive[k]
            ]
            assert len(boundaries) == 1, (frame, previous, chosen)
            early += frame < boundaries[0]
            late += frame > boundaries[0]
    assert early > 50
    assert late > 50
    assert 200 < on_the_way < 600


def test_without_misleading_instructions_the_draws_stay_what_they_were(demonstrations, town2, say, labels):
    """Every number that is drawn, one by one: trainings are reproducible across versions."""
    subtask, drive, lane = labels
    snippets = cut_snippets(subtask, drive)
    found, rng = find_segments(town2, snippets, lane), random.Random(7)
    sampler = BoundarySampler(demonstrations, town2, seed=7)
    index, _ = sampler.sample(demonstrations.storage, 20 * sampler.decisions)
    for frames in index.view(20, -1).tolist():
        answers = {}
        for each in found[rng.choice(list(KEYWORDS.values())).name]:
            answers.setdefault(each.manoeuvres, []).append(each)
        ways = list(answers.values())
        segment = rng.choice(rng.choices(ways, [len(way) ** 0.5 for way in ways])[0]).snippets
        boundary = int(snippets.start[segment[1]])
        earliest = snippets.start[segment[0]] if rng.random() < 0.25 else max(snippets.start[segment[0]], boundary - 70)
        frame = rng.randint(int(earliest), boundary + 16)
        assert frames[0] == frame
        for _ in segment[1 + (frame >= boundary) :]:
            rng.randint(-4, 8)
        rng.random()  # whether it is nonsense
    assert sampler.state_dict()["random"] == rng.getstate()


def test_rare_answers_are_drawn_more_often_than_driven(demonstrations, town2, say, labels):
    subtask, drive, lane = labels
    driven = {}
    for segment in find_segments(town2, cut_snippets(subtask, drive), lane)["first left"]:
        driven[segment.manoeuvres] = driven.get(segment.manoeuvres, 0) + 1
    assert len(driven) > 1
    sampler = BoundarySampler(demonstrations, town2, seed=3)
    index, info = sampler.sample(demonstrations.storage, 4000 * sampler.decisions)
    shape = (4000, sampler.decisions)
    rows = index.view(shape), {key: value.view(*shape, *value.shape[1:]) for key, value in info.items()}
    drawn = [
        tuple(k for k in target if k not in (FOLLOW, FINISH))
        for keyword, _, target, _ in sequences(rows)
        if keyword == "first left"
    ]
    weights = {answer: count**0.5 for answer, count in driven.items()}
    for answer, weight in weights.items():
        share = weight / sum(weights.values())
        assert drawn.count(answer) / len(drawn) == pytest.approx(share, abs=0.08), answer
        if driven[answer] < max(driven.values()):
            assert share > driven[answer] / sum(driven.values())


def test_every_misleading_route_is_a_segment(town):
    for name in SAFE_KEYWORDS:
        for route in misleading_routes(town, name):
            lanes = list(route.lanes)
            if route.stops:  # whatever the car does there
                lanes.append(town.successors(lanes[-1])[-1])
            lane = torch.tensor(lanes).repeat_interleave(10)
            subtask = town.lane_manoeuvre[lane]
            snippets = cut_snippets(subtask, torch.zeros_like(lane))
            answer = (*route.manoeuvres, FINISH) if route.stops else route.manoeuvres
            whole = segments.Segment(tuple(range(len(snippets.subtask))), answer)
            for most in (1, 2, 3):
                groups = find_misleading(town, snippets, lane, most)[name]
                assert ([whole] in groups) == (len(answer) <= most)
            assert whole not in find_segments(town, snippets, lane)[name]


def safe_answers(town, keyword, junctions):
    """By the paper's rule, at the junction lanes that a car crosses, and whether the map misleads the keyword there."""
    answers, misled = [], False
    for asked, junction in zip(keyword.manoeuvres, junctions, strict=False):
        offered = {int(town.lane_manoeuvre[k]) for k in town.successors(int(town.lane_predecessor[junction]))}
        misled |= asked not in offered
        if asked not in offered and SubTask.STRAIGHT not in offered:
            return [*answers, FINISH], misled
        answers.append(asked if asked in offered else SubTask.STRAIGHT)
    return answers, misled


def test_misleading_decisions_are_the_safe_ones(demonstrations, town2, say, labels):
    subtask, drive, lane = labels
    sampler = BoundarySampler(demonstrations, town2, misleading=1.0)
    index, info = sampler.sample(demonstrations.storage, 600 * sampler.decisions)
    shape = (600, sampler.decisions)
    rows = index.view(shape), {key: value.view(*shape, *value.shape[1:]) for key, value in info.items()}
    count, at_once = {}, 0
    for name, frames, target, _ in sequences(rows):
        if name is None:
            continue
        ahead = lane[frames[0] :][drive[frames[0] :] == drive[frames[0]]]
        crossed = [k for k in ahead.unique_consecutive().tolist() if town2.lane_manoeuvre[k] != FOLLOW]
        answers, misled = safe_answers(town2, KEYWORDS[name], crossed)
        assert misled
        stops = answers[-1] == FINISH
        assert [k for k in target if k != FOLLOW] == (answers if stops else [*answers, FINISH])
        assert all((a == FOLLOW) != (b == FOLLOW) for a, b in pairwise(target[:-1] if not stops else target))
        if answers == [FINISH]:
            # At once where the junction is in sight: the manoeuvre there begins at most 18 frames on.
            near = bool((subtask[frames[0] : frames[0] + 19] != FOLLOW).any())
            assert target == ([FINISH] if near else [FOLLOW, FINISH])
            at_once += near
        count.setdefault(name, []).append(tuple(answers))
    assert set(count) == set(SAFE_KEYWORDS)
    assert at_once > 20
    for name, found in count.items():
        assert 35 < len(found) < 90, name
        assert len(found) / len(set(found)) * 0.5 < min(map(found.count, set(found))), name


def test_misleading_is_a_share(demonstrations, town2, say):
    sampler = BoundarySampler(demonstrations, town2, misleading=0.25)
    index, info = sampler.sample(demonstrations.storage, 800 * sampler.decisions)
    shape = (800, sampler.decisions)
    rows = index.view(shape), {key: value.view(*shape, *value.shape[1:]) for key, value in info.items()}
    misled = [
        [k for k in target if k not in (FOLLOW, FINISH)] != list(KEYWORDS[name].manoeuvres)
        for name, _, target, _ in sequences(rows)
        if name in SAFE_KEYWORDS
    ]
    assert 0.25 * 0.8 * 800 < sum(misled) < 0.25 * 1.2 * 800


def test_real_sentences_are_said(demonstrations, town2):
    sampler = BoundarySampler(demonstrations, town2)
    _, info = sampler.sample(demonstrations.storage, 100 * sampler.decisions)
    tokens = info[keys.INSTRUCTION_TOKENS].view(100, sampler.decisions, -1)[:, 0]
    assert len(tokens.unique(dim=0)) > 80
    assert ((tokens != 0).sum(1) >= 1).all()


def test_a_buffer_writes_what_the_sampler_says(demonstrations, town2):
    def sample(seed):
        sampler = BoundarySampler(demonstrations, town2, seed=seed)
        return TensorDictReplayBuffer(
            storage=demonstrations.storage, sampler=sampler, batch_size=3 * sampler.decisions
        ).sample()

    first, again, other = sample(0), sample(0), sample(1)
    sampler = BoundarySampler(demonstrations, town2)
    index, info = sampler.sample(demonstrations.storage, 3 * sampler.decisions)
    assert first.shape == (3 * sampler.decisions,)
    assert torch.equal(first[keys.POSE], demonstrations.storage[:][keys.POSE][index])
    for key, value in info.items():
        assert torch.equal(first[key], value)
        assert torch.equal(first[key], again[key])
    assert not torch.equal(first[keys.POSE], other[keys.POSE])


@pytest.mark.usefixtures("global_rng")
def test_state_goes_on_where_it_was(demonstrations, town2, tmp_path):
    sampler = BoundarySampler(demonstrations, town2)
    sampler.sample(demonstrations.storage, sampler.decisions)
    sampler.dumps(tmp_path / "state")
    expected, _ = sampler.sample(demonstrations.storage, 4 * sampler.decisions)
    fresh = BoundarySampler(demonstrations, town2, seed=5)
    fresh.loads(tmp_path / "state")
    assert torch.equal(fresh.sample(demonstrations.storage, 4 * sampler.decisions)[0], expected)


def test_errors_say_what_to_do(demonstrations, few, town2, monkeypatch):
    sampler = BoundarySampler(demonstrations, town2)
    size = sampler.decisions + 1
    with pytest.raises(ValueError, match=f"batch of {size} does not divide into sequences of {size - 1} decisions"):
        sampler.sample(demonstrations.storage, size)
    with pytest.raises(ValueError, match=r"no drive in 60 frames of town2 realises .*second right; collect more"):
        BoundarySampler(few, town2)
    stored = few.storage[:]
    snippets = cut_snippets(stored[keys.SUBTASK], stored[TRAJECTORY])
    nothing = find_misleading(town2, snippets, stored[keys.ROUTE][:, 1].long())
    monkeypatch.setattr(segments, "find_misleading", lambda *_: nothing)
    with pytest.raises(ValueError, match=r"no drive in 19200 frames of town2 is misled by left, .*; collect more"):
        BoundarySampler(demonstrations, town2, misleading=0.1)
