"""Sub-task labels along routes, against the lanes' own geometry."""

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv

from ldrl import keys
from ldrl.collectors.expert import Expert
from ldrl.envs import SubtaskLabels, TownEnv
from ldrl.envs.labels import APPROACH, route_subtask
from ldrl.language import KEYWORDS
from ldrl.subtasks import MANOEUVRES, SubTask
from ldrl.towns import ROUTE_LANES, plan_routes


def windows(town, lanes):
    """Route windows with each of the lanes as the current one."""
    lanes = list(lanes)
    padded = [int(town.lane_predecessor[lanes[0]]), *lanes]
    while len(padded) < len(lanes) + ROUTE_LANES:
        padded.append(town.successors(padded[-1])[0])
    return torch.tensor([padded[k : k + ROUTE_LANES] for k in range(len(lanes))])


def expected_subtask(town, lanes, k, along):
    """By hand: the junction lane's manoeuvre, from 6 m before its entry to its exit."""
    if town.lane_manoeuvre[lanes[k]] in MANOEUVRES:
        return int(town.lane_manoeuvre[lanes[k]])
    ahead = float(town.lane_length[lanes[k]]) - along
    for lane in lanes[k + 1 :]:
        if ahead > APPROACH:
            break
        if town.lane_manoeuvre[lane] in MANOEUVRES:
            return int(town.lane_manoeuvre[lane])
        ahead += float(town.lane_length[lane])
    return int(SubTask.LANEFOLLOW)


@pytest.mark.parametrize("keyword", ["left,straight", "right,left", "second right", "first left"])
def test_every_point_along_a_planned_route(town, keyword):
    for route in plan_routes(town, KEYWORDS[keyword])[:6]:
        lanes = route.lanes
        rows = windows(town, lanes)
        changes = []
        for k, lane in enumerate(lanes[:-1]):
            position = np.arange(0.05, float(town.lane_length[lane]), 0.5, dtype=np.float32)
            found = route_subtask(town, rows[k].expand(len(position), -1), torch.tensor(position)).tolist()
            assert found == [expected_subtask(town, lanes, k, float(s)) for s in position]
            changes += [s for s in found if not changes or s != changes[-1]][:1] if len(set(found)) == 1 else found
        sequence = [SubTask(s) for i, s in enumerate(changes) if i == 0 or s != changes[i - 1]]
        assert [s for s in sequence if s != SubTask.LANEFOLLOW] == list(route.manoeuvres)


def test_corners_without_a_junction_stay_lanefollow(town):
    corners = [
        i
        for i in range(len(town.lane_length))
        if town.lane_manoeuvre[i] == SubTask.LANEFOLLOW and len(town.points[town.lane_first[i] :]) > 1
        and abs(float(town.headings[town.lane_first[i] + int(town.lane_length[i] / town.lane_spacing[i])]
                      - town.headings[town.lane_first[i]])) > 1
    ]  # fmt: skip
    assert corners
    for corner in corners:
        rows = windows(town, (corner,))
        position = torch.arange(0, float(town.lane_length[corner]), 0.5)
        far = position < float(town.lane_length[corner] + town.lane_to_junction[corner]) - APPROACH
        found = route_subtask(town, rows.expand(len(position), -1), position)
        assert (found == SubTask.LANEFOLLOW)[far].all()
        assert far.any()


def test_end_of_subtask_is_exactly_at_changes(town):
    env = TransformedEnv(TownEnv(town, 32, seed=0, max_steps=150), SubtaskLabels(town))
    rollout = env.rollout(300, Expert(town), break_when_any_done=False)
    before, after = rollout[keys.SUBTASK], rollout["next", keys.SUBTASK]
    assert torch.equal(rollout["next", keys.END_OF_SUBTASK], before != after)
    assert set(before.unique().tolist()) == {0, 1, 2, 3}
    assert rollout["next", keys.END_OF_SUBTASK].sum() > 50
    # the first step of a drive ends nothing, also not the drive before
    first = torch.cat((torch.ones(32, 1, dtype=torch.bool), rollout["next", "done"].squeeze(-1)[:, :-1]), 1)
    assert first.sum() == 64
    assert not rollout[keys.END_OF_SUBTASK][first].any()
    same = ~first[:, 1:]
    assert torch.equal(rollout[keys.END_OF_SUBTASK][:, 1:][same], rollout["next", keys.END_OF_SUBTASK][:, :-1][same])


def test_labels_follow_the_routes_state(town2):
    env = TransformedEnv(TownEnv(town2, 16, seed=3), SubtaskLabels(town2))
    rollout = env.rollout(200, Expert(town2), break_when_any_done=False)
    labels = route_subtask(town2, rollout[keys.ROUTE], rollout[keys.ROUTE_POSITION].squeeze(-1))
    assert torch.equal(labels, rollout[keys.SUBTASK])
    assert rollout[keys.SUBTASK].dtype == torch.int64
