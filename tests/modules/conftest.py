"""A tiny agent, and inputs for it that need no world."""

import pytest
import torch
from tensordict import TensorDict

from ldrl import keys
from ldrl.language import Tokenizer
from ldrl.modules import AgentConfig, HierarchicalAgent

SENTENCES = ("turn left", "take the second right", "go straight", "left and then straight please", "zzyzzyx")


@pytest.fixture(scope="session")
def tiny():
    return AgentConfig(
        image_rows=48,
        conv_channels=(2, 3, 4),
        features=8,
        low_level_hidden=6,
        instruction_hidden=6,
        subtask_embedding=3,
        high_level_hidden=7,
    )


@pytest.fixture
def agent(tiny):
    """Random weights, large enough that images, words and history all show in what it does."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        agent = HierarchicalAgent(tiny)
        for parameter in agent.parameters():
            parameter.data.mul_(2)
    return agent.eval()


@pytest.fixture(scope="session")
def observe():
    """Random images and sentences for some cars, the same for the same seed."""
    tokens = Tokenizer()(SENTENCES)

    def observe(cars, seed):
        generator = torch.Generator().manual_seed(seed)
        td = TensorDict(batch_size=[cars])
        coarse = torch.randint(0, 2, (cars, 1, 11, 25), generator=generator, dtype=torch.uint8)
        td[keys.IMAGE] = coarse.repeat_interleave(8, -1).repeat_interleave(8, -2) * 255
        td[keys.INSTRUCTION_TOKENS] = tokens[torch.arange(cars) % len(tokens)]
        return td

    return observe


@pytest.fixture(scope="session")
def begin(observe):
    """The first step of some cars: what they see, and the agent's memory as an env resets it."""

    def begin(agent, cars, seed=0):
        td = observe(cars, seed)
        for key, spec in agent.make_tensordict_primer().primers.items(True, True):
            td[key] = spec.zero((cars,))
        return td

    return begin


@pytest.fixture(scope="session")
def drive(begin, observe):
    """Some steps of an agent through random images: ``[cars, steps]`` of what it did."""

    def drive(agent, cars, steps, rows=slice(None)):
        td, done = begin(agent, cars)[rows], []
        for step in range(steps):
            done.append(agent(td.clone()))
            td = done[-1]["next"].update(observe(cars, step + 1)[rows])
        return torch.stack(done, 1)

    return drive
