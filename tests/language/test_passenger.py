"""What passengers say in training: it keeps its meaning, varies, and fits the tokenizer."""

import random
import re
from collections import Counter
from importlib import resources

import pytest
import yaml

from ldrl.language import KEYWORDS, MEANINGFUL, SAFE_KEYWORDS, Families, Passenger, Sentences, load_glove, normalise
from ldrl.language.passenger import DECISIVE, DENIALS
from ldrl.language.spoken import training_words

DIRECTIONS = {"left", "right", "straight"}


@pytest.fixture(scope="module")
def spoken():
    return yaml.safe_load((resources.files("ldrl.language") / "spoken.yaml").read_text("utf-8"))


def read_templates():
    folder = resources.files("ldrl.language") / "templates"
    return [yaml.safe_load(file.read_text("utf-8")) for file in folder.iterdir()]


@pytest.fixture(scope="module")
def passenger():
    return Passenger()


def said(passenger, name, count, seed=0):
    rng = random.Random(seed)
    return [passenger.say(name, rng) for _ in range(count)]


def only(monkeypatch, **shares):
    """Let nothing happen to a sentence but what is named."""
    for name in ("CLEAN", "SHORTENED", "CORRECTED", "FILLED", "TALKED", "REPEATED", "SLIPPED", "DISTURBED", "LOOSE"):
        monkeypatch.setattr(f"ldrl.language.passenger.{name}", shares.get(name, 0.0))
    monkeypatch.setattr("ldrl.language.passenger._unsaid", frozenset)


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


@pytest.mark.parametrize("name", KEYWORDS)
def test_what_a_test_says_is_never_said_even_misspelt(passenger, monkeypatch, name):
    read = passenger.tokenizer.read
    tests = {" ".join(read(text)) for test in (Sentences("heldout"), Families("ambiguity")) for text in test.all(name)}
    tests = {text for text in tests if " " in text}
    assert tests.isdisjoint(" ".join(read(sentence)) for sentence in said(passenger, name, 2000))
    monkeypatch.setattr("ldrl.language.passenger._unsaid", frozenset)
    assert not tests.isdisjoint(" ".join(read(sentence)) for sentence in said(passenger, name, 20_000))


def test_clean_sentences_are_those_of_the_templates(passenger, monkeypatch):
    only(monkeypatch, CLEAN=1.0)
    assert set(said(passenger, "straight", 200)) <= set(Sentences("train").all("straight"))


@pytest.mark.parametrize("name", KEYWORDS)
def test_loose_phrasings_name_the_directions_of_their_keyword(passenger, monkeypatch, spoken, name):
    """But for a turn that is called the other way."""
    only(monkeypatch, CLEAN=1.0, LOOSE=1.0)
    monkeypatch.setattr("ldrl.language.passenger.OPTIONAL", 0.0)
    meant = {manoeuvre.name.lower() for manoeuvre in KEYWORDS[name].manoeuvres}
    sentences = said(passenger, name, 500)
    assert len(set(sentences)) > 80
    opposite = {part.format(dir=KEYWORDS[name].manoeuvres[0].name.lower()) for part in spoken["slots"]["opposite"]}
    for sentence in sentences:
        if sentence not in opposite:
            assert {word.removesuffix("s") for word in sentence.split()} >= meant - {"straight"}, sentence


def test_parts_leave_their_directions_open(spoken):
    """Straight is also said as neither left nor right, and what comes right after something is not on the right."""
    of_a_turn = [
        "turn",
        "turn_statement",
        "double",
        "double_turns",
        "reversed",
        "reversed_turns",
        "same",
        "first",
        "second",
        "opposite",
    ]
    for part in (part for slot in of_a_turn for part in spoken["slots"][slot]):
        named = re.sub(r"\bright (after|behind|away|now|here)\b", "", part).split()
        assert not {"left", "right", "lefts", "rights"}.intersection(named), part


def test_slots_are_used_and_their_parts_clean(spoken):
    slots = spoken["slots"]
    used = {slot.strip("()").partition(":")[0] for group in spoken["groups"] for s in group["sentences"] for slot in s}
    assert used | {"corrections", "confirmations", "fillers", "talk"} == slots.keys()
    assert {name for group in spoken["groups"] for name in group["keywords"]} == KEYWORDS.keys()
    for parts in slots.values():
        assert len(set(parts)) == len(parts)
        assert all(re.fullmatch(r"([a-z0-9{}]+ ?)+", part) for part in parts)


def test_nothing_held_out_is_said(spoken):
    heldout = {part for file in read_templates() for slot in file["slots"].values() for part in slot["heldout"]} - {""}
    heldout = {part.replace("{then}", "{dir}") for part in heldout}
    for part in (part.replace("{then}", "{dir}") for slot in spoken["slots"].values() for part in slot):
        assert part not in heldout
        assert not any(f" {other} " in f" {part} " for other in heldout if " " in other), part


@pytest.mark.parametrize("name", ["second left", "left,right", "straight"])
def test_what_says_which_way_survives_random_words(passenger, monkeypatch, name):
    only(monkeypatch, DISTURBED=1.0)
    rng = random.Random(3)
    changed = 0
    for _ in range(300):
        state = rng.getstate()
        plain = passenger._phrase(KEYWORDS[name], rng).split()
        rng.setstate(state)
        sentence = passenger.say(name, rng).split()
        decisive = [[word for word in text if word in DECISIVE] for text in (plain, sentence)]
        assert decisive[0] == decisive[1]
        changed += sentence != plain
    assert 150 < changed < 300


@pytest.mark.parametrize("name", KEYWORDS)
def test_shortened_commands_keep_what_says_which_way(passenger, spoken, monkeypatch, name):
    only(monkeypatch, SHORTENED=1.0)
    rng = random.Random(3)
    terse = Counter()
    for _ in range(300):
        state = rng.getstate()
        plain = passenger._phrase(KEYWORDS[name], rng).split()
        rng.setstate(state)
        sentence = passenger.say(name, rng).split()
        assert [word for word in plain if word in MEANINGFUL] == [word for word in sentence if word in MEANINGFUL]
        assert inside(sentence, plain)
        terse[len(sentence) < len(plain)] += 1
        lost = set(Counter(plain) - Counter(sentence))
        assert lost <= set(spoken["spare"]) or set(name.replace(",", " ").split()) <= set(sentence)
    assert terse[True] > 60


@pytest.mark.parametrize(
    ("name", "sentence", "shortest"),
    [
        ("first left", "go left as soon as you can", "go left as soon as can"),  # nothing would be left but left
        ("left,right", "please turn right once you have gone left", "turn right once have gone left"),
        ("left", "do not go straight but take a left", "do not go straight but take left"),
        ("right", "do not let this right go by", "do not let this right go by"),
        ("straight", "at the lights you make no turn", "at the lights you make no turn"),  # names no direction
        ("second left", "let the first left go by and take the second", "let first left go by and take second"),
        ("left,left", "turn left and do the same at the next one", "turn left and do same next one"),
        ("left", "just a second then please go left", "just second then go left"),
    ],
)
def test_commands_that_need_their_words_lose_none_but_spare_ones(passenger, name, sentence, shortest):
    heard = {" ".join(passenger._shorten(KEYWORDS[name], sentence.split(), random.Random(k))) for k in range(200)}
    assert min(heard, key=len) == shortest
    assert all(inside(shortest.split(), some.split()) and inside(some.split(), sentence.split()) for some in heard)


def test_no_two_keywords_shorten_to_the_same(passenger):
    class Terse(random.Random):
        def uniform(self, low, high):  # of the rate at which words go
            return high

    rng, meant = Terse(3), {}
    for name, keyword in KEYWORDS.items():
        for _ in range(3000):
            shortest = passenger._shorten(keyword, passenger._phrase(keyword, rng).split(), rng)
            assert meant.setdefault(tuple(shortest), name) == name


def test_a_shortened_command_does_not_turn_its_order_round(passenger):
    words = ["left", "and", "right", "after", "that"]
    heard = {" ".join(passenger._shorten(KEYWORDS["left,right"], words, random.Random(k))) for k in range(50)}
    assert "left right" in heard
    assert not any("after" in sentence for sentence in heard)


def test_corrections_end_with_what_is_meant(passenger, monkeypatch, spoken):
    only(monkeypatch, CORRECTED=1.0)
    markers = {tuple(marker.split()) for marker in spoken["slots"]["corrections"]}
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
    monkeypatch.setattr("ldrl.language.passenger.DENIED", 0.0)
    for words in map(str.split, said(passenger, "right", 50)):
        again = [k for k in range(1, len(words) // 2 + 1) if words[:k] == words[-k:]]
        assert any("right" in words[:k] for k in again), words


def test_a_denial_follows_what_is_meant(passenger, monkeypatch):
    only(monkeypatch, REPEATED=1.0)
    monkeypatch.setattr("ldrl.language.passenger.DENIED", 1.0)
    for words in map(str.split, said(passenger, "right", 50)):
        before = [words[:k] for k in range(len(words)) if " ".join(words[k:]).startswith(DENIALS)]
        assert any(b[:k] == b[-k:] and "right" in b[:k] for b in before for k in range(1, len(b) // 2 + 1)), words


def test_slips_change_a_letter_or_take_a_word_for_another(passenger, monkeypatch):
    only(monkeypatch, SLIPPED=1.0)
    counts = Counter("left" in sentence.split() for sentence in said(passenger, "left", 400))
    assert counts[False] > 100
    assert counts[True] > 100


def test_nonsense_never_commands(passenger, spoken):
    rng = random.Random(0)
    assert DECISIVE.isdisjoint(passenger._words)
    nonsense = {passenger.nonsense(rng) for _ in range(2000)}
    assert nonsense.isdisjoint(sentence for name in KEYWORDS for sentence in Sentences("train").all(name))
    random_words = nonsense - set(spoken["slots"]["talk"])
    assert DECISIVE.isdisjoint(word for sentence in random_words for word in sentence.split())


def test_training_words_are_known_and_start_with_the_meaningful():
    words = training_words()
    assert len(set(words)) == len(words) > 150
    assert all(word in load_glove().words for word in words if len(word) > 1)
    count = sum(word in MEANINGFUL for word in words)
    assert set(words[:count]) <= MEANINGFUL
    assert {"left", "right", "straight", "first", "second", "skip"} <= set(words)
    assert all(normalise(word) == [word] for word in words)


@pytest.mark.parametrize("keywords", [KEYWORDS, SAFE_KEYWORDS])
def test_what_is_meant_is_never_denied(passenger, monkeypatch, keywords):
    monkeypatch.setattr("ldrl.language.passenger.DENIED", 1.0)
    monkeypatch.setattr(passenger, "_phrase", lambda keyword, _: keyword.name.replace(" ", "_"))
    rng = random.Random(5)
    denied = {passenger._repeat(keywords["left,right"], ["go"], rng)[-1] for _ in range(500)}
    assert denied == {name.replace(" ", "_") for name in KEYWORDS} - {"left,right"}
