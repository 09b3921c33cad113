"""Sentences and what they mean, to train what reads them."""

from __future__ import annotations

import random

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from ldrl import keys
from ldrl.collectors.demonstrations import TRAJECTORY
from ldrl.language import KEYWORDS, PADDING, Passenger

__all__ = ["collect_sentences"]

NONSENSE = 0.05
"""Share of sentences that ask for nothing."""


def collect_sentences(count: int, batch_size: int, seed: int = 0) -> TensorDictReplayBuffer:
    """What passengers say, as many sentences of each keyword, and some that ask for nothing.

    A sample holds sentences of about the same length, so that little is padding: they are stored from short to long,
    as one trajectory that slices are taken from.

    Args:
        count: how many sentences.
        batch_size: of a sample.
        seed: of what they say.

    Returns:
        A buffer of ``instruction_tokens``, ``[48]`` int64, and ``keyword``, ``[]`` int64: its index among
        :data:`~ldrl.language.KEYWORDS`, or their number where nothing is asked for.
    """
    rng, passenger = random.Random(seed), Passenger()
    sentences, meant = [], []
    for _ in range(count):
        keyword = len(KEYWORDS) if rng.random() < NONSENSE else rng.randrange(len(KEYWORDS))
        meant.append(keyword)
        known = keyword < len(KEYWORDS)
        sentences.append(passenger.say(list(KEYWORDS)[keyword], rng) if known else passenger.nonsense(rng))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(count),
        sampler=SliceSampler(num_slices=1, traj_key=TRAJECTORY, truncated_key=None, cache_values=True),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )
    tokens = passenger.tokenizer(sentences)
    by_length = (tokens != PADDING).sum(-1).argsort(stable=True)
    said = {keys.INSTRUCTION_TOKENS: tokens, keys.KEYWORD: torch.tensor(meant)}
    buffer.extend(TensorDict(said, [count])[by_length].set(TRAJECTORY, torch.zeros(count, dtype=torch.long)))
    return buffer
