"""The checkpoints that ship with the package drive."""

import dataclasses

import pytest

from ldrl.collectors import evaluate
from ldrl.envs.segmenter import SHIPPED
from ldrl.language import KEYWORDS
from ldrl.modules import PRETRAINED, HierarchicalAgent, resolve_checkpoint

MODALITIES = ("gs", "ps", "rgb")


@pytest.fixture(scope="module")
def agents():
    return {modality: HierarchicalAgent.from_pretrained(f"hierarchical-{modality}") for modality in MODALITIES}


def test_ship_with_their_reports_and_are_small():
    assert tuple(f"hierarchical-{modality}" for modality in MODALITIES) == PRETRAINED
    sizes = sum(file.stat().st_size for file in SHIPPED.rglob("*"))  # the segmenter of ps
    for name in PRETRAINED:
        files = {file.name: file.stat().st_size for file in resolve_checkpoint(name).iterdir()}
        assert {"agent.json", "report.md"} <= set(files)
        assert files.get("agent.safetensors", 0) <= 4 * 2**20
        sizes += sum(files.values())
    assert sizes <= 12 * 2**20


@pytest.mark.parametrize("modality", MODALITIES)
def test_drives_a_few_episodes_to_success(agents, modality, towns, episodes):
    assert agents[modality].modality == modality
    shortest = sorted((e for some in episodes.values() for e in some), key=lambda e: len(e.path))
    some = [
        next(e for e in shortest if e.town == town and KEYWORDS[e.keyword].type == kind)
        for town in towns
        for kind in ("single", "double", "ordinal")
    ]
    outcomes = evaluate(agents[modality], some, towns)
    assert [outcome.episode.id for outcome in outcomes if not outcome.success] == []
    assert sum(outcome.strict_success for outcome in outcomes) >= 5


@pytest.mark.parametrize("instruction", ["word " * 5000, "zzyzzyx qqrgh", "\U0001f600 \u2b05", "the price of the fish"])
def test_stays_on_the_road_whatever_is_said(agents, towns, episodes, instruction):
    odd = [dataclasses.replace(episode, instruction=instruction) for episode in episodes["town2"][::30]]
    for outcome in evaluate(agents["gs"], odd, towns):
        assert not outcome.off_road, outcome.episode.id
        assert not outcome.collision, outcome.episode.id
