"""The towns, compiled once for all tests; nobody may change them."""

import pytest

from ldrl.envs import builtin_episodes
from ldrl.towns import Town


@pytest.fixture(scope="session")
def towns():
    return {name: Town.load(name) for name in ("town1", "town2")}


@pytest.fixture(scope="session")
def town1(towns):
    return towns["town1"]


@pytest.fixture(scope="session")
def town2(towns):
    return towns["town2"]


@pytest.fixture(params=("town1", "town2"), scope="session")
def town(request, towns):
    return towns[request.param]


@pytest.fixture(scope="session")
def episodes(towns):
    return {name: builtin_episodes(town) for name, town in towns.items()}
