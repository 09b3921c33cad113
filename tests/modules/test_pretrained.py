"""The checkpoint that ships with the package."""

import dataclasses

import pytest

from ldrl.collectors import evaluate
from ldrl.modules import PRETRAINED, HierarchicalAgent, resolve_checkpoint

DRIVEN = ("left-0", "right-1", "straight-2", "left-right-0", "straight-straight-1", "first-right-0", "second-left-0")


@pytest.fixture(scope="module")
def agent():
    return HierarchicalAgent.from_pretrained("hierarchical-gs")


def test_ships_with_its_report_and_is_small():
    assert PRETRAINED == ("hierarchical-gs",)
    files = {file.name: file.stat().st_size for file in resolve_checkpoint("hierarchical-gs").iterdir()}
    assert {"agent.safetensors", "agent.json", "report.md"} <= set(files)
    assert sum(files.values()) <= 4 * 2**20


def test_drives_to_success_in_both_towns(agent, towns, episodes):
    chosen = [e for name in towns for e in episodes[name] if e.id.removeprefix(f"{name}-") in DRIVEN]
    assert len(chosen) == 2 * len(DRIVEN)
    outcomes = evaluate(agent, chosen, towns)
    assert [outcome.episode.id for outcome in outcomes if not outcome.strict_success] == []


@pytest.mark.parametrize("instruction", ["word " * 5000, "zzyzzyx qqrgh", "\U0001f600 \u2b05", "the price of the fish"])
def test_stays_on_the_road_whatever_is_said(agent, towns, episodes, instruction):
    odd = [dataclasses.replace(episode, instruction=instruction) for episode in episodes["town2"][::30]]
    for outcome in evaluate(agent, odd, towns):
        assert not outcome.off_road, outcome.episode.id
        assert not outcome.collision, outcome.episode.id
