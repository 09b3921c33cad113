"""Evaluation: one drive per episode, and what a drive is worth."""

import json
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from ldrl import keys
from ldrl.collectors import Expert, evaluate, evaluation
from ldrl.collectors.evaluation import _judge
from ldrl.envs import Episode
from ldrl.modules import AgentConfig, HierarchicalAgent
from ldrl.subtasks import SubTask

PATH = tuple((float(x), 0.0) for x in range(31))
EPISODE = Episode("by hand", "town1", "straight", "go straight", (0.0, 0.0, 0.0), PATH)


class Dice(TensorDictModuleBase):
    """Random actions."""

    in_keys = [keys.POSE]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self):
        super().__init__()
        self.generator = torch.Generator().manual_seed(0)

    def forward(self, tensordict):
        action = torch.rand(*tensordict.shape, 2, generator=self.generator)
        tensordict[keys.ACTION] = action * torch.tensor([1.0, 2.0]) - torch.tensor([0.0, 1.0])
        return tensordict


@pytest.fixture(scope="module")
def sample(episodes):
    """Some of each town by turns, of many keywords, longer and shorter ones mixed."""
    pairs = zip(episodes["town1"][5::29], reversed(episodes["town2"][3::23]), strict=False)
    return [episode for pair in pairs for episode in pair]


@pytest.fixture(scope="module")
def untrained():
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return HierarchicalAgent(AgentConfig(conv_channels=(2, 3, 4), features=8, low_level_hidden=6))


@pytest.fixture(scope="module")
def outcomes(sample, towns):
    return evaluate(Expert, sample, towns)


def drive(track, *, finish=None, speed=5.0, **flags):
    """A drive made by hand: its track, where ``finish`` is declared, and flags raised at one frame each."""
    td = TensorDict(batch_size=[len(track)])
    td[keys.POSE] = torch.tensor([[x, y, 0.0] for x, y in track])
    td[keys.SPEED] = torch.full((len(track), 1), speed)
    for key in (keys.COLLISION, keys.OFF_ROAD, keys.WRONG_LANE):
        td[key] = torch.zeros(len(track), 1, dtype=torch.bool)
        if key[1] in flags:
            td[key][flags[key[1]]] = True
    declared = torch.zeros(len(track), dtype=torch.bool)
    if finish is not None:
        declared[finish:] = True
    td[keys.AGENT_FINISH] = declared
    td[keys.AGENT_SUBTASK] = torch.where(declared, int(SubTask.FINISH), int(SubTask.STRAIGHT))
    return td


def along(last=30.0, y=0.0):
    return [(k * 0.5, y) for k in range(int(last * 2) + 1)]


@pytest.mark.parametrize(
    ("made", "success", "strict"),
    [
        (drive(along(), finish=58), True, True),
        (drive(along(60.0), finish=60), True, True),  # driving on does not matter
        (drive(along(20.5), finish=38), True, True),  # the last point is 9.5 m away
        (drive(along(19.5), finish=38), False, False),  # 10.5 m
        (drive(along(y=9.9), finish=58), True, True),
        (drive(along(y=10.1), finish=58), False, False),
        (drive(along()[12:], finish=46), True, True),
        (drive(along()[22:], finish=38), False, False),  # begins 11 m behind the path's first point
        (drive(along()[:10] + along()[52:], finish=15), False, False),  # a hole of 21 m: its middle is 10.5 m away
        (drive(along(), finish=58, collision=3), False, False),
        (drive(along(), finish=58, collision=60), False, False),
        (drive(along(), finish=58, off_road=0), True, False),
        (drive(along(), finish=58, off_road=30), True, False),
        (drive(along(), finish=58, wrong_lane=30), True, False),
        (drive(along()), True, False),
        (drive(along(), finish=31), True, True),  # declared 14.5 m before the end
        (drive(along(), finish=29), True, False),  # 15.5 m
        (drive(along(), finish=len(along()) - 1), True, False),  # at the last frame, after which nothing is driven
        (drive(along(60.0), finish=89), True, True),  # 14.5 m behind it
        (drive(along(60.0), finish=91), True, False),
        (drive([(math.nan, math.nan)] * 5, finish=2), False, False),
        (drive([*along(), (math.nan, 0.0)], finish=58), False, False),
    ],
)
def test_judged_by_hand(made, success, strict):
    outcome = _judge(EPISODE, made)
    assert (outcome.success, outcome.strict_success) == (success, strict)
    assert outcome.episode is EPISODE


@pytest.mark.parametrize(
    ("made", "success", "strict"),
    [
        (drive(along(), finish=58, speed=0.05), True, True),
        (drive(along(), finish=58, speed=0.2), False, False),  # still rolls
        (drive(along(39.5), finish=58, speed=0.0), True, True),
        (drive(along(40.5), finish=58, speed=0.0), False, False),  # stands too far on
        (drive(along(20.5), finish=38, speed=0.0), True, True),
        (drive(along(60.0) + along()[::-1], finish=58, speed=0.0), False, False),  # was there, but stands elsewhere
        (drive([*along(), *((30.0, y) for y in range(12))], finish=58, speed=0.0), False, False),  # turned
        (drive(along(), speed=0.0), True, False),
        (drive(along(), finish=29, speed=0.0), True, False),
        (drive(along(), finish=58, speed=0.0, collision=60), False, False),
    ],
)
def test_stops_judged_by_hand(made, success, strict):
    outcome = _judge(replace(EPISODE, stop=True), made)
    assert (outcome.success, outcome.strict_success) == (success, strict)


def test_what_an_outcome_says():
    outcome = _judge(EPISODE, drive(along(24.0), finish=40, off_road=7, speed=0.05))
    assert outcome.finished
    assert outcome.finish_distance == 10.0
    assert outcome.largest_gap == 6.0
    assert outcome.seconds == 4.8
    assert (outcome.collision, outcome.off_road, outcome.wrong_lane) == (False, True, False)
    assert not outcome.stuck  # it stands because it has finished
    assert outcome.track.tolist() == [list(point) for point in along(24.0)]
    assert outcome.subtasks.tolist() == [SubTask.STRAIGHT] * 40 + [SubTask.FINISH] * 9
    never = _judge(EPISODE, drive(along(), speed=0.05))
    assert never.stuck
    assert not never.finished
    assert never.finish_distance is None
    assert not _judge(EPISODE, drive(along())).stuck


def test_what_is_chosen_at_the_last_frame_is_not_driven():
    made = drive(along())
    made[keys.AGENT_SUBTASK][-1] = SubTask.LEFT
    assert _judge(EPISODE, made).subtasks[-1] == SubTask.STRAIGHT
    assert made[keys.AGENT_SUBTASK][-1] == SubTask.LEFT


def test_finish_counts_where_it_was_declared_first():
    made = drive(along(), finish=58)
    made[keys.AGENT_FINISH][10] = True
    outcome = _judge(EPISODE, made)
    assert outcome.finish_distance == 25.0
    assert not outcome.strict_success


def test_policies_without_subtasks_follow_lanes():
    made = drive(along()).exclude(keys.AGENT_FINISH, keys.AGENT_SUBTASK)
    outcome = _judge(EPISODE, made)
    assert outcome.success
    assert not outcome.strict_success
    assert (outcome.subtasks == SubTask.LANEFOLLOW).all()


def test_records_are_json():
    outcome = _judge(EPISODE, drive(along(), finish=58))
    record = json.loads(json.dumps(outcome.record()))
    assert record["id"] == "by hand"
    assert [record[name] for name in ("town", "keyword", "instruction")] == ["town1", "straight", "go straight"]
    assert {"success", "strict_success", "collision", "off_road", "wrong_lane", "finished", "stuck"} <= set(record)
    assert not {"track", "subtasks", "episode"} & set(record)


def test_the_expert_is_perfect(outcomes):
    for outcome in outcomes:
        assert outcome.success, outcome.episode.id
        assert outcome.strict_success, outcome.episode.id
        assert outcome.largest_gap < 2
        assert outcome.finish_distance < 2
        assert not outcome.stuck


def test_outcomes_come_in_the_order_of_the_episodes(outcomes, sample):
    assert [outcome.episode for outcome in outcomes] == sample
    for outcome in outcomes:
        assert math.dist(outcome.track[0], outcome.episode.start[:2]) < 0.01
        assert len(outcome.track) == len(outcome.subtasks)
        assert outcome.track.isfinite().all()
        assert outcome.seconds == pytest.approx((len(outcome.track) - 1) / 10)
        steps = (outcome.track[1:] - outcome.track[:-1]).norm(dim=-1)
        assert steps.max() < 0.8  # no jump: nothing of another drive


def test_exactly_one_drive_per_episode(sample, towns, monkeypatch):
    driven, ended = [], []
    make_env = evaluation.make_env

    def spy(town, *, episodes, **options):
        driven.extend(episode.id for episode in episodes)
        assert len(episodes) <= 3
        return make_env(town, episodes=episodes, **options)

    monkeypatch.setattr(evaluation, "make_env", spy)
    twice = [*sample[:4], sample[0]]
    outcomes = evaluate(Expert, twice, towns, num_cars=3, progress=ended.append)
    assert sorted(driven) == sorted(episode.id for episode in twice)
    assert [outcome.episode for outcome in outcomes] == twice
    assert torch.equal(outcomes[0].track, outcomes[4].track)
    assert sum(ended) == 5


@pytest.mark.parametrize(("num_cars", "at_first"), [(512, 5), (4, 4), (2, 2)])
def test_who_still_drives_in_any_town_is_asked_at_once(sample, towns, num_cars, at_first):
    asked = []

    class Counting(Dice):
        def forward(self, tensordict):
            asked.append(len(tensordict))
            return super().forward(tensordict)

    outcomes = evaluate(Counting(), sample[:5], towns, num_cars=num_cars)
    assert asked[0] == max(asked) == at_first
    assert sum(asked) == sum(len(outcome.track) - 1 for outcome in outcomes)


@pytest.mark.parametrize("num_cars", [1, 5])
def test_the_number_of_cars_changes_nothing(sample, towns, outcomes, num_cars):
    some = slice(0, 6)
    for found, expected in zip(evaluate(Expert, sample[some], towns, num_cars=num_cars), outcomes[some], strict=True):
        assert found.record() == expected.record()
        torch.testing.assert_close(found.track, expected.track)


def test_agents_do_not_depend_on_their_neighbours(untrained, sample, towns):
    some = sorted(sample, key=lambda episode: len(episode.path))[:3]
    together = evaluate(untrained, some, towns)
    alone = evaluate(untrained, some, towns, num_cars=1)
    for one, other in zip(together, alone, strict=True):
        assert one.episode == other.episode
        torch.testing.assert_close(one.track[:100], other.track[:100], atol=1e-3, rtol=0)
        assert torch.equal(one.subtasks[:100], other.subtasks[:100])


def test_random_driving_nearly_always_fails(untrained, episodes, towns):
    turns = [episode for episode in episodes["town2"] if episode.keyword in ("left", "right")]
    for policy, some in ((Dice(), episodes["town1"][::6] + episodes["town2"][::6]), (untrained, turns)):
        outcomes = evaluate(policy, some, towns)
        assert len(outcomes) == len(some)
        assert sum(outcome.success for outcome in outcomes) <= 0.15 * len(some)
        assert not any(outcome.strict_success for outcome in outcomes)
        assert any(outcome.off_road or outcome.stuck or outcome.finished for outcome in outcomes)


def test_subtasks_are_the_agents(untrained, sample, towns):
    shortest = min(sample, key=lambda episode: len(episode.path))
    outcome = evaluate(untrained, [shortest], towns)[0]
    assert outcome.finished == bool((outcome.subtasks == SubTask.FINISH).any())


def test_unknown_towns_and_no_episode(sample, towns):
    with pytest.raises(ValueError, match="num_cars is 0; give at least 1"):
        evaluate(Expert, sample, towns, num_cars=0)
    with pytest.raises(ValueError, match=r"unknown town 'town2'; use one of town1"):
        evaluate(Expert, sample, {"town1": towns["town1"]})
    assert evaluate(Expert, [], towns) == []
