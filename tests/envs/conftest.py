"""Worlds with traffic."""

import pytest
import torch

from ldrl.envs.traffic import Agent
from ldrl.towns import Layout, Town
from ldrl.towns.layout import Node


@pytest.fixture(scope="session")
def crossing():
    """Nine nodes in a square of 160 m: a four-way junction in the middle, T-junctions on the sides, four corners."""
    nodes = {f"{i}{j}": Node(80.0 * i, 80.0 * j, 8.0) for i in range(3) for j in range(3)}
    streets = [[f"{i}{j}" for i in range(3)] for j in range(3)] + [[f"{i}{j}" for j in range(3)] for i in range(3)]
    return Town("crossing", Layout("crossing", 4.0, nodes, tuple(map(tuple, streets))).network())


@pytest.fixture
def nobody():
    """Makes agents that are nowhere near."""

    def make(worlds):
        zero = torch.zeros(worlds)
        return Agent(torch.full((worlds, 3), 1e6), zero, torch.zeros(worlds, 6, dtype=torch.long), zero)

    return make
