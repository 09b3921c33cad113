"""The towns, compiled once for all tests; nobody may change them."""

import pytest

from ldrl.envs import builtin_episodes
from ldrl.towns import Layout, Town
from ldrl.towns.layout import Node


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


@pytest.fixture(scope="session")
def square():
    """Streets 100 m long, centre lines on x, y = 0 and 100, 8 m wide and 0.3 m of shoulder on either side."""
    nodes = {"a": Node(0, 0, 8), "b": Node(100, 0, 8), "c": Node(100, 100, 8), "d": Node(0, 100, 8)}
    return Town("square", Layout("square", 4.0, nodes, (("a", "b", "c", "d", "a"),)).network())
