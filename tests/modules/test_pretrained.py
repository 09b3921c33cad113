"""The checkpoint that ships with the package drives."""

import dataclasses

import pytest

from ldrl.collectors import evaluate
from ldrl.language import KEYWORDS
from ldrl.modules import PRETRAINED, HierarchicalAgent, resolve_checkpoint


@pytest.fixture(scope="module")
def agent():
    return HierarchicalAgent.from_pretrained("hierarchical-gs")


def test_ships_with_its_report_and_is_small():
    assert PRETRAINED == ("hierarchical-gs",)
    files = {file.name: file.stat().st_size for file in resolve_checkpoint("hierarchical-gs").iterdir()}
    assert {"agent.safetensors", "agent.json", "report.md"} <= set(files)
    assert sum(files.values()) <= 4 * 2**20


def test_drives_a_few_episodes_to_success(agent, towns, episodes):
    shortest = sorted((e for some in episodes.values() for e in some), key=lambda e: len(e.path))
    some = [
        next(e for e in shortest if e.town == town and KEYWORDS[e.keyword].type == kind)
        for town in towns
        for kind in ("single", "double", "ordinal")
    ]
    outcomes = evaluate(agent, some, towns)
    assert [outcome.episode.id for outcome in outcomes if not outcome.success] == []
    assert sum(outcome.strict_success for outcome in outcomes) >= 5


@pytest.mark.parametrize("instruction", ["word " * 5000, "zzyzzyx qqrgh", "\U0001f600 \u2b05", "the price of the fish"])
def test_stays_on_the_road_whatever_is_said(agent, towns, episodes, instruction):
    odd = [dataclasses.replace(episode, instruction=instruction) for episode in episodes["town2"][::30]]
    for outcome in evaluate(agent, odd, towns):
        assert not outcome.off_road, outcome.episode.id
        assert not outcome.collision, outcome.episode.id
