"""Demonstrations that hold every keyword."""

import pytest
import torch

from ldrl import keys
from ldrl.collectors import collect_demonstrations
from ldrl.collectors.demonstrations import TRAJECTORY


@pytest.fixture(scope="session")
def demonstrations(town2, tmp_path_factory):
    return collect_demonstrations(town2, 32 * 600, num_cars=32, path=tmp_path_factory.mktemp("demonstrations"))


@pytest.fixture(scope="session")
def few(town2, tmp_path_factory):
    """Too few for anything to be sampled."""
    return collect_demonstrations(town2, 4 * 15, num_cars=4, path=tmp_path_factory.mktemp("few"))


@pytest.fixture(scope="session")
def labels(demonstrations):
    """Sub-task, drive and lane of every frame."""
    stored = demonstrations.storage[:]
    return stored[keys.SUBTASK].clone(), stored[TRAJECTORY].clone(), stored[keys.ROUTE][:, 1].long()


@pytest.fixture
def global_rng():
    """Fails the test that draws from torch's global generator."""
    before = torch.random.get_rng_state()
    yield
    assert torch.equal(torch.random.get_rng_state(), before)
