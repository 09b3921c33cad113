"""What the passengers say, when it changes and from which seed."""

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from ldrl import keys
from ldrl.envs import Instruction, TownEnv
from ldrl.language import KEYWORDS, Sentences, Tokenizer

SENTENCES = ["turn left", "take the second right", "go straight"]


def make(town, cars=3, *args, max_steps=5, **kwargs):
    return TransformedEnv(TownEnv(town, cars, seed=0, max_steps=max_steps), Instruction(*args, **kwargs))


def step(env, td):
    td[keys.ACTION] = torch.tensor([0.3, 0.0]).expand(*env.batch_size, 2)
    return env.step(td)["next"]


def test_every_car_keeps_its_own_sentence(town2):
    env = make(town2, 3, SENTENCES, text=True)
    rollout = env.rollout(12, break_when_any_done=False)  # over two resets
    expected = Tokenizer()(SENTENCES)
    assert (rollout[keys.INSTRUCTION_TOKENS] == expected.unsqueeze(1)).all()
    assert (rollout["next", keys.INSTRUCTION_TOKENS] == expected.unsqueeze(1)).all()
    assert [row[0] for row in rollout[keys.INSTRUCTION]] == SENTENCES


def test_draws_at_reset_only(town2):
    env = make(town2, 40, text=True)
    first = env.reset()
    said = first[keys.INSTRUCTION]
    td = first
    for _ in range(4):
        td = step(env, td)
        assert torch.equal(td[keys.INSTRUCTION_TOKENS], first[keys.INSTRUCTION_TOKENS])
        assert td[keys.INSTRUCTION] == said
    assert len(set(said)) > 20
    again = env.reset()[keys.INSTRUCTION]
    assert sum(a == b for a, b in zip(said, again, strict=True)) < 10


def test_tokens_are_those_of_the_text(town2):
    td = make(town2, 10, text=True).reset()
    assert torch.equal(td[keys.INSTRUCTION_TOKENS], Tokenizer()(list(td[keys.INSTRUCTION])))


def test_draws_for_the_reset_rows_only(town2):
    env = make(town2, 40)
    td = env.reset()
    tokens = td[keys.INSTRUCTION_TOKENS]
    copy = tokens.clone()
    mask = torch.arange(40) % 2 == 0
    td = step(env, td)
    td = env.reset(td.set("_reset", mask.unsqueeze(-1)))
    again = td[keys.INSTRUCTION_TOKENS]
    assert torch.equal(again[~mask], copy[~mask])
    assert torch.equal(step(env, td)[keys.INSTRUCTION_TOKENS], again)  # nor do they change afterwards
    assert (again[mask] != copy[mask]).any(-1).sum() > 10
    assert torch.equal(tokens, copy)  # what was given out stays


def test_split_and_keywords(town2):
    for split in ("train", "heldout"):
        env = make(town2, 60, split=split, keywords=["left", "(second, right)"], text=True)
        allowed = {*Sentences(split).all("left"), *Sentences(split).all("second right")}
        assert set(env.reset()[keys.INSTRUCTION]) <= allowed


def test_every_keyword_is_drawn(town2, monkeypatch):
    drawn = []
    sample = Sentences.sample
    monkeypatch.setattr(Sentences, "sample", lambda self, k, rng: drawn.append(k.name) or sample(self, k, rng))
    make(town2, 500).reset()
    assert set(drawn) == set(KEYWORDS)


def test_seeded(town2):
    def said(seed):
        return make(town2, 20, seed=seed).reset()[keys.INSTRUCTION_TOKENS]

    state = torch.get_rng_state()
    assert torch.equal(said(1), said(1))
    assert not torch.equal(said(1), said(2))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("text", [False, True])
def test_specs(town2, text):
    check_env_specs(make(town2, 2, text=text))
    check_env_specs(make(town2, 3, SENTENCES, text=text))


def test_odd_sentences_are_said(town2):
    odd = ["left " * 5000, "🚗🚗", "qwertz uiopue", "LEFT, please!!"]
    tokens = make(town2, 4, odd).reset()[keys.INSTRUCTION_TOKENS]
    assert (tokens[0] == tokens[0, 0]).all()
    assert (tokens[:, 0] > 0).all()


def test_bad_arguments_are_named(town2):
    with pytest.raises(ValueError, match="unknown keyword 'third left'"):
        Instruction(keywords=["third left"])
    with pytest.raises(ValueError, match="unknown split 'test'"):
        Instruction(split="test")
    with pytest.raises(ValueError, match="3 sentences for 2 cars; give one to each"):
        make(town2, 2, SENTENCES).reset()
    with pytest.raises(ValueError, match=r"the instruction ' \.\.\. ' has no word"):
        make(town2, 1, [" ... "]).reset()
