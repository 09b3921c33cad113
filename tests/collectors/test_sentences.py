"""Sentences to learn from: as many of each keyword, alike in length within a sample, the same for a seed."""

import pytest
import torch

from ldrl import keys
from ldrl.collectors import collect_sentences
from ldrl.language import KEYWORDS, PADDING


@pytest.fixture(scope="module")
def buffer():
    return collect_sentences(3000, 50, seed=3)


def test_keywords_are_said_equally_often_and_nonsense_at_times(buffer):
    counts = buffer.storage[:][keys.KEYWORD].bincount(minlength=len(KEYWORDS) + 1)
    assert len(counts) == len(KEYWORDS) + 1
    assert counts[:-1].min() > 150
    assert 100 < counts[-1] < 200


def test_a_sample_has_little_padding_and_samples_reach_everywhere(buffer):
    lengths, widest = [], []
    for _ in range(300):
        sample = buffer.sample()
        length = (sample[keys.INSTRUCTION_TOKENS] != PADDING).sum(-1)
        assert length.shape == (50,)
        lengths.append(length)
        widest.append(int(length.max()))
    mean = float(torch.stack(lengths).float().mean())
    every = (buffer.storage[:][keys.INSTRUCTION_TOKENS] != PADDING).sum(-1)
    assert mean == pytest.approx(float(every.float().mean()), rel=0.1)
    assert sum(widest) / len(widest) < 1.2 * mean
    assert min(map(int, map(torch.min, lengths))) < float(every.float().quantile(0.02)) + 1
    assert max(widest) > float(every.float().quantile(0.98))


def test_a_seed_is_one_sequence_of_samples(buffer):
    first, again, other = (collect_sentences(500, 20, seed=seed) for seed in (1, 1, 2))
    one, same, another = (b.sample()[keys.INSTRUCTION_TOKENS] for b in (first, again, other))
    assert torch.equal(one, same)
    assert not torch.equal(one, another)
