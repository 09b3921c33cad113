"""The switching controller, case by case."""

from dataclasses import dataclass

import pytest
import torch
from tensordict import TensorDict

from ldrl import keys
from ldrl.modules import NO_SUBTASK, SwitchingController
from ldrl.subtasks import SubTask

LEFT, STRAIGHT, FOLLOW, FINISH = SubTask.LEFT, SubTask.STRAIGHT, SubTask.LANEFOLLOW, SubTask.FINISH
OLD, NEW = (7, 8, 0), (7, 9, 0)


@dataclass
class Case:
    what: str
    switch: bool
    subtask: SubTask = FOLLOW
    votes: tuple[int, int, int] = (0, 0, 0)
    age: int = 20
    heard: tuple[int, int, int] = OLD
    new_plan: bool = False


CASES = [
    Case("the first step always decides", True, age=0, new_plan=True),
    Case("the first step decides, whatever an env left in the memory", True, LEFT, (0, 0, 0), 0, NEW, True),
    Case("no vote", False),
    Case("one vote of three", False, votes=(0, 0, 1)),
    Case("the newer two of three", True, votes=(0, 1, 1)),
    Case("the older two of three", True, votes=(1, 1, 0)),
    Case("the outer two of three", True, votes=(1, 0, 1)),
    Case("three of three", True, LEFT, (1, 1, 1)),
    Case("two votes of two: too early", False, votes=(0, 1, 1), age=2),
    Case("two votes of the first three", True, votes=(0, 1, 1), age=3),
    Case("a finished agent stays so", False, FINISH, (1, 1, 1)),
    Case("a new instruction while following a lane", True, heard=NEW, new_plan=True),
    Case("a new instruction one step after the last decision", True, age=1, heard=NEW, new_plan=True),
    Case("a new instruction when finished", True, FINISH, heard=NEW, new_plan=True),
    Case("a new instruction in a manoeuvre waits", False, LEFT, heard=NEW),
    Case("a new instruction in a manoeuvre waits for the second vote", False, STRAIGHT, (0, 1, 0), heard=NEW),
    Case("a new instruction is planned for when the manoeuvre ends", True, LEFT, (0, 1, 1), heard=NEW, new_plan=True),
    Case("a new instruction that came with the end of lane following", True, FOLLOW, (0, 1, 1), 9, NEW, True),
    Case("an instruction that gets one word longer", True, heard=(7, 8, 5), new_plan=True),
]


@pytest.fixture
def batch():
    td = TensorDict(batch_size=[len(CASES)])
    td[keys.INSTRUCTION_TOKENS] = torch.tensor([case.heard for case in CASES])
    td[keys.PLANNED_TOKENS] = torch.tensor([OLD] * len(CASES))
    td[keys.AGENT_SUBTASK] = torch.tensor([case.subtask for case in CASES])
    td[keys.VOTES] = torch.tensor([case.votes for case in CASES]).bool()
    td[keys.AGE] = torch.tensor([case.age for case in CASES])
    td[keys.HIGH_LEVEL_STATE] = torch.ones(len(CASES), 2)
    return td


@pytest.mark.parametrize("row", range(len(CASES)), ids=[case.what for case in CASES])
def test_case(batch, row):
    case = CASES[row]
    out = SwitchingController()(batch)[row]
    assert bool(out[keys.SWITCH]) == case.switch
    assert tuple(out[keys.PLANNED_TOKENS].tolist()) == (case.heard if case.new_plan else OLD)
    if case.switch:
        assert out[keys.PREVIOUS_SUBTASK] == (NO_SUBTASK if case.new_plan else case.subtask)
        assert out[keys.HIGH_LEVEL_STATE].tolist() == ([0, 0] if case.new_plan else [1, 1])
    else:
        assert out[keys.HIGH_LEVEL_STATE].tolist() == [1, 1]


def test_keys_and_inputs(batch):
    before = batch.clone()
    controller = SwitchingController()
    controller(batch)
    assert set(batch.keys(True, True)) - set(before.keys(True, True)) <= set(controller.out_keys)
    for key in set(controller.in_keys) - set(controller.out_keys):
        assert torch.equal(batch[key], before[key])


def test_a_waiting_instruction_is_remembered():
    """Heard in a manoeuvre, it is still news when the manoeuvre has ended, however long that takes."""
    td = TensorDict(batch_size=[1])
    td[keys.INSTRUCTION_TOKENS], td[keys.PLANNED_TOKENS] = torch.tensor([NEW]), torch.tensor([OLD])
    td[keys.AGENT_SUBTASK], td[keys.HIGH_LEVEL_STATE] = torch.tensor([int(LEFT)]), torch.ones(1, 2)
    td[keys.AGE] = torch.tensor([10])
    for votes, expected in [((0, 0, 0), False), ((0, 0, 1), False), ((0, 1, 0), False), ((1, 0, 1), True)]:
        td[keys.VOTES] = torch.tensor([votes]).bool()
        assert bool(SwitchingController()(td)[keys.SWITCH]) == expected
    assert td[keys.PREVIOUS_SUBTASK].item() == NO_SUBTASK
