import random
import re
from collections import Counter
from importlib import resources

import pytest
import yaml

from ldrl.language import KEYWORDS, Sentences, load_glove, normalise
from ldrl.language.tokens import Tokenizer

TRAIN, HELDOUT = Sentences("train"), Sentences("heldout")
SINGLES = {"left": 150, "right": 150, "straight": 454}
AT_LEAST = {
    "left,left": 269_550,
    "right,right": 269_550,
    "left,right": 135_000,
    "right,left": 135_000,
    "left,straight": 408_600,
    "right,straight": 408_600,
    "straight,straight": 85,
    "first left": 102_150,
    "first right": 102_150,
    "second left": 105_450,
    "second right": 105_450,
}
UNMIRRORED = [name for name in KEYWORDS if not name.startswith("right") and not name.endswith(" right")]
DIRECTIONS = {"left", "right", "straight"}


def mirror(text):
    swap = {"left": "right", "right": "left"}
    return re.sub(r"\b(left|right)\b", lambda match: swap[match[0]], text)


@pytest.fixture(scope="module")
def templates():
    folder = resources.files("ldrl.language") / "templates"
    return {file.name: yaml.safe_load(file.read_text("utf-8")) for file in folder.iterdir()}


def test_number_of_sentences_is_of_the_papers_scale():
    total = {name: TRAIN.count(name) + HELDOUT.count(name) for name in KEYWORDS}
    for name, count in SINGLES.items():
        assert total[name] == pytest.approx(count, rel=0.1)
    for name, count in AT_LEAST.items():
        assert total[name] >= count
        assert TRAIN.count(name) <= 2.5 * count


@pytest.mark.parametrize("name", UNMIRRORED)
def test_sentences_are_distinct_and_held_out_ones_are_new(name):
    train, heldout = list(TRAIN.all(name)), list(HELDOUT.all(name))
    assert len(set(train)) == len(train) == TRAIN.count(name)
    assert len(set(heldout)) == len(heldout) == HELDOUT.count(name)
    assert set(train).isdisjoint(heldout)
    assert all(sentence == sentence.strip() and "  " not in sentence for sentence in train[:2000] + heldout)
    assert max(len(sentence.split()) for sentence in train + heldout) <= Tokenizer().max_tokens


@pytest.mark.parametrize("name", ["left", "left,right", "straight,straight", "first left", "second left"])
def test_right_mirrors_left(name):
    for sentences in (TRAIN, HELDOUT):
        assert {mirror(sentence) for sentence in sentences.all(name)} == set(sentences.all(mirror(name)))


def test_no_sentence_says_two_keywords():
    rng = random.Random(0)
    owner = {}
    for name in KEYWORDS:
        for sentences in (TRAIN, HELDOUT):
            few = sentences.count(name) < 20_000
            for sentence in sentences.all(name) if few else (sentences.sample(name, rng) for _ in range(20_000)):
                assert owner.setdefault(sentence, name) == name


@pytest.mark.parametrize("name", KEYWORDS)
def test_directions_and_ordinals_of_a_sentence_are_those_of_its_keyword(name):
    rng = random.Random(1)
    keyword = KEYWORDS[name]
    said = {manoeuvre.name.lower() for manoeuvre in keyword.manoeuvres}
    for sentences in (TRAIN, HELDOUT):
        for _ in range(2000):
            sentence = sentences.sample(name, rng)
            words = sentence.split()
            named = DIRECTIONS.intersection(words)
            if keyword.type == "ordinal":
                # A street is counted on one side only; going straight until there is said freely.
                assert named - {"straight"} == said, sentence
            else:
                assert named == said or (name == "straight" and re.search("cross|through|pass", sentence)), sentence
                assert not {"first", "second"}.intersection(words) or "at first" in sentence, sentence
                assert not re.search(r"next (left|right)", sentence), sentence


def test_held_out_parts_stand_in_no_training_part(templates):
    train, heldout = set(), set()
    for file in templates.values():
        for slot in file["slots"].values():
            train.update(slot["train"])
            heldout.update(slot["heldout"])
    assert train & heldout == {""}
    # {then} reads like {dir} once it is filled in.
    plain = [f" {part} ".replace("{then}", "{dir}") for part in train]
    for part in heldout - {""}:
        assert not any(f" {part} ".replace("{then}", "{dir}") in other for other in plain), part


def test_every_group_holds_out_a_part_that_no_sentence_can_leave_out(templates):
    used = set()
    for file in templates.values():
        slots = {**templates["common.yaml"]["slots"], **file["slots"]}
        for group in file["groups"]:
            used.update(group["sentence"])
            assert any("" not in slots[slot]["heldout"] for slot in group["sentence"])
    names = [slot for file in templates.values() for slot in file["slots"]]
    assert used == set(names)
    assert len(names) == len(set(names)), "a slot is defined in two files"


def test_words_are_normal_and_in_glove_and_mostly_trained():
    words = {"train": Counter(), "heldout": Counter()}
    rng = random.Random(2)
    for sentences in (TRAIN, HELDOUT):
        for name in KEYWORDS:
            for _ in range(1000):
                sentence = sentences.sample(name, rng)
                assert normalise(sentence) == sentence.split()
                words[sentences.split].update(sentence.split())
    assert not (words["train"] | words["heldout"]).keys() - load_glove().words.keys()
    known = sum(count for word, count in words["heldout"].items() if word in words["train"])
    assert known / words["heldout"].total() > 0.75


def test_sampling_draws_the_group_first():
    rng = random.Random(3)
    drawn = Counter(TRAIN.sample("straight,straight", rng) for _ in range(30_000))
    assert set(drawn) == set(TRAIN.all("straight,straight"))
    # Three groups, of which the shortest sentences make the smallest.
    bare = sum(count for sentence, count in drawn.items() if sentence.startswith("straight"))
    assert bare / 30_000 == pytest.approx(1 / 3, abs=0.02)


def test_sampling_depends_on_the_generator_alone():
    def draw(seed):
        rng = random.Random(seed)
        return [TRAIN.sample(name, rng) for name in KEYWORDS for _ in range(5)]

    random.seed(0)
    state = random.getstate()
    first = draw(0)
    assert random.getstate() == state
    assert draw(0) == first
    assert draw(1) != first


def test_keyword_spellings_and_bad_input():
    assert TRAIN.count("(First, left)") == TRAIN.count(KEYWORDS["first left"])
    with pytest.raises(ValueError, match="unknown keyword 'backwards'"):
        TRAIN.sample("backwards", random.Random(0))
    with pytest.raises(ValueError, match="unknown split 'test': use one of train, heldout"):
        Sentences("test")
