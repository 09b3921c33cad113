"""What passengers say in training: it keeps its meaning, varies, and fits the tokenizer."""

import random
from collections import Counter
from importlib import resources

import pytest
import yaml

from ldrl.language import KEYWORDS, MEANINGFUL, Passenger, Sentences, load_glove, normalise
from ldrl.language.passenger import training_words

DIRECTIONS = {"left", "right", "straight"}


@pytest.fixture(scope="module")
def spoken():
    return yaml.safe_load((resources.files("ldrl.language") / "spoken.yaml").read_text("utf-8"))


@pytest.fixture(scope="module")
def passenger():
    return Passenger()


def said(passenger, name, count, seed=0):
    rng = random.Random(seed)
    return [passenger.say(name, rng) for _ in range(count)]


def only(monkeypatch, **shares):
    """Let nothing happen to a sentence but what is named."""
    for name in ("CLEAN", "CORRECTED", "FILLED", "TALKED", "REPEATED", "SLIPPED", "DISTURBED", "LOOSE"):
        monkeypatch.setattr(f"ldrl.language.passenger.{name}", shares.get(name, 0.0))


def inside(words, sentence):
    """Whether words stand in a sentence in this order."""
    rest = iter(sentence)
    return all(word in rest for word in words)


@pytest.mark.parametrize("name", KEYWORDS)
def test_sentences_vary_and_fit(passenger, name):
    sentences = said(passenger, name, 500)
    assert len(set(sentences)) > 400
    assert all(sentence and len(sentence.split()) <= 48 for sentence in sentences)
    assert sentences == said(passenger, name, 500)
    assert sentences != said(passenger, name, 500, seed=1)


def test_clean_sentences_are_those_of_the_templates(passenger, monkeypatch):
    only(monkeypatch, CLEAN=1.0)
    assert set(said(passenger, "straight", 200)) <= set(Sentences("train").all("straight"))


@pytest.mark.parametrize("name", KEYWORDS)
def test_phrasings_name_the_directions_of_their_keyword(name, spoken):
    keyword = KEYWORDS[name]
    meant = {manoeuvre.name.lower() for manoeuvre in keyword.manoeuvres}
    words = {"dir": keyword.manoeuvres[0].name.lower(), "then": keyword.manoeuvres[-1].name.lower()}
    bodies = [body for group in spoken["phrasings"] if name in group["keywords"] for body in group["bodies"]]
    assert len(bodies) >= 15
    for body in bodies:
        named = DIRECTIONS.intersection(word.removesuffix("s") for word in body.format(**words).split())
        if "straight" in meant:  # it is also said as not turning, or of a turn as "right over"
            named -= {"right", "left"} - meant
            named.add("straight")
        assert named == meant, body


def test_what_says_which_way_survives_random_words(passenger, monkeypatch):
    only(monkeypatch, DISTURBED=1.0)
    rng = random.Random(3)
    changed = 0
    for _ in range(300):
        state = rng.getstate()
        plain = passenger._phrase(KEYWORDS["second left"], rng).split()
        rng.setstate(state)
        sentence = passenger.say("second left", rng).split()
        assert inside([word for word in plain if word in MEANINGFUL], sentence)
        changed += sentence != plain
    assert 200 < changed < 300


def test_corrections_end_with_what_is_meant(passenger, monkeypatch, spoken):
    only(monkeypatch, CORRECTED=1.0)
    markers = {tuple(marker.split()) for marker in spoken["corrections"]}
    for sentence in said(passenger, "left", 300):
        words = sentence.split()
        ends = [k + len(m) for m in markers for k in range(len(words)) if tuple(words[k : k + len(m)]) == m]
        assert ends
        assert {"left"} == DIRECTIONS.intersection(words[max(ends) :]), sentence


def test_talk_uses_direction_words_in_another_sense(passenger, monkeypatch):
    only(monkeypatch, TALKED=1.0)
    sentences = said(passenger, "left", 1000)
    assert sum("right" in sentence.split() for sentence in sentences) > 100
    assert all("left" in sentence.split() for sentence in sentences)


def test_repetitions_say_the_same_twice(passenger, monkeypatch):
    only(monkeypatch, REPEATED=1.0)
    assert all(sentence.split().count("right") == 2 for sentence in said(passenger, "right", 50))


def test_slips_change_a_letter_or_take_a_word_for_another(passenger, monkeypatch):
    only(monkeypatch, SLIPPED=1.0)
    counts = Counter("left" in sentence.split() for sentence in said(passenger, "left", 400))
    assert counts[False] > 100
    assert counts[True] > 100


def test_nonsense_never_commands(passenger):
    rng = random.Random(0)
    commands = set(Sentences("train").all("left")) | set(Sentences("train").all("straight"))
    assert not commands.intersection(passenger.nonsense(rng) for _ in range(2000))


def test_training_words_are_known_and_start_with_the_meaningful():
    words = training_words()
    assert len(set(words)) == len(words) > 150
    assert all(word in load_glove().words for word in words if len(word) > 1)
    count = sum(word in MEANINGFUL for word in words)
    assert set(words[:count]) <= MEANINGFUL
    assert {"left", "right", "straight", "first", "second", "skip"} <= set(words)
    assert all(normalise(word) == [word] for word in words)
