"""The four families: as broad as they should be, decodable, and nothing in them that was trained on."""

import random
import re
from importlib import resources
from itertools import product
from typing import get_args

import pytest
import yaml

from ldrl.language import KEYWORDS, MAX_TOKENS, Families, Family, Sentences, normalise
from ldrl.language.slips import slip

FAMILIES = get_args(Family)
UNMIRRORED = [name for name in KEYWORDS if not name.startswith("right") and not name.endswith(" right")]
TURNS = {"left": "right", "right": "left"}


def read(folder):
    return {
        file.name.removesuffix(".yaml"): yaml.safe_load(file.read_text("utf-8"))
        for file in (resources.files("ldrl.language") / folder).iterdir()
        if file.name.endswith(".yaml")
    }


def draw(family, name, count, seed=0):
    rng, sentences = random.Random(seed), Families(family)
    return [sentences.sample(name, rng) for _ in range(count)]


def filled(parts):
    """What parts can read like, as tuples of words."""
    directions = ("left", "right", "straight")
    said = set()
    for one, other, nth in product(directions, directions, ("first", "second")):
        words = {"dir": one, "then": other, "nth": nth, "other": other, "other_then": other, "other_nth": nth}
        said.update(tuple(normalise(part.format(**words))) for part in parts)
    return said


@pytest.fixture(scope="module")
def trained():
    parts = [part for file in read("templates").values() for slot in file["slots"].values() for part in slot["train"]]
    spoken = yaml.safe_load((resources.files("ldrl.language") / "spoken.yaml").read_text("utf-8"))
    return filled([*parts, *(part for slot in spoken["slots"].values() for part in slot)])


@pytest.fixture(scope="module")
def said():
    files = read("families")
    assert files.keys() == set(FAMILIES)
    # Noise has no parts: it garbles held-out sentences, of which test_sentences.py shows that they are new. What it
    # hears instead of a word is compared below.
    return filled(part for file in files.values() for slot in file.get("slots", {}).values() for part in slot)


def test_no_training_part_is_a_part_of_a_family(trained, said):
    """Only trained parts are shown, so that who changes them need not look at the blind test."""
    shared = {" ".join(words) for words in trained if len(words) > 1 and words in said}
    assert not shared, "training parts that a blind test says as well: take others"


def test_no_word_is_misheard_as_in_training():
    spoken = yaml.safe_load((resources.files("ldrl.language") / "spoken.yaml").read_text("utf-8"))
    misheard = read("families")["noise"]["misheard"]
    assert set(misheard) & set(spoken["slips"])
    words = [word for slips in (misheard, spoken["slips"]) for slip in slips.items() for word in (slip[0], *slip[1])]
    assert {type(word) for word in words} == {str}, "quote what YAML takes for a truth value: on, off, yes, no"
    heard = {(word, " ".join(normalise(said))) for word, others in misheard.items() for said in others}
    shared = {(word, said) for word, others in spoken["slips"].items() for said in others} & heard
    assert not shared, "slips of the training that the blind test makes as well: take others"
    assert not {(word, said) for word, said in heard if word == said}


def test_no_long_training_part_stands_inside_a_family(trained, said):
    text = "|".join(f" {' '.join(words)} " for words in said)
    shared = {" ".join(words) for words in trained if len(words) >= 5 and f" {' '.join(words)} " in text}
    assert not shared, "training parts of five or more words that a blind test says as well: take others"


@pytest.mark.parametrize("name", UNMIRRORED)
def test_no_sentence_is_a_training_sentence(name):
    spoken = {
        sentence
        for family in FAMILIES
        for sentence in (" ".join(normalise(sentence)) for sentence in draw(family, name, 2000))
        if " " in sentence  # a single bare word is the exception: nobody can say "left" in other words than "left"
    }
    shared = {sentence for sentence in Sentences("train").all(name) if sentence in spoken}
    assert not shared, "training sentences that a blind test says as well: take others"


@pytest.mark.parametrize(
    ("family", "least"), [("paraphrase", 500), ("ambiguity", 70), ("noise", 500), ("rambling", 800)]
)
@pytest.mark.parametrize("name", KEYWORDS)
def test_families_are_broad(family, least, name):
    assert len({" ".join(normalise(sentence)) for sentence in draw(family, name, 1000)}) >= least


def test_paraphrases_and_small_talk_are_many():
    files = read("families")
    paraphrase, rambling = files["paraphrase"]["slots"], files["rambling"]["slots"]
    least = {
        25: [("turn", "turn_statement"), ("onward", "onward_statement"), ("turn_then", "whole_then")],
        20: [("nth", "nearest", "nearest_statement"), ("nth", "beyond", "beyond_statement")],
    }
    assert all(sum(len(paraphrase[slot]) for slot in slots) >= count for count, some in least.items() for slots in some)
    assert len({*rambling["before"], *rambling["after"], *rambling["aside"]}) >= 40
    assert len({*rambling["repair"], *rambling["repair_word"], *rambling["repair_nth"]}) >= 10


def test_no_slot_is_unused_or_says_a_part_too_often():
    for family, file in read("families").items():
        if family != "noise":
            used = {slot for group in file["groups"] for slot in group["sentence"]} - {"command"}
            assert used == file["slots"].keys()
            assert all({*group["keywords"]} <= KEYWORDS.keys() for group in file["groups"])
            for parts in file["slots"].values():
                assert len({*parts} - {""}) == sum(part != "" for part in parts), parts


def test_the_longest_sentence_fits_the_tokenizer():
    longest = {name: max(len(s.split()) for s in Sentences("heldout").all(name)) for name in KEYWORDS}
    for family in ("paraphrase", "ambiguity", "rambling"):
        file = read("families")[family]
        words = {slot: max(map(len, filled(parts))) for slot, parts in file["slots"].items()}
        for group in file["groups"]:
            for name in group["keywords"]:
                total = sum(longest[name] if slot == "command" else words[slot] for slot in group["sentence"])
                assert total <= MAX_TOKENS, (family, group["sentence"])
    # One slip makes at most two words of one.
    assert max(longest.values()) + 3 <= MAX_TOKENS


@pytest.mark.parametrize("family", ["paraphrase", "ambiguity"])
@pytest.mark.parametrize("name", KEYWORDS)
def test_only_the_directions_of_the_keyword_are_named(family, name):
    turns = {manoeuvre.name.lower() for manoeuvre in KEYWORDS[name].manoeuvres} - {"straight"}
    for sentence in draw(family, name, 500):
        named = {word.removesuffix("s") for word in normalise(sentence)} & TURNS.keys()
        assert named == turns, sentence


@pytest.mark.parametrize("family", ["paraphrase", "ambiguity"])
@pytest.mark.parametrize("name", ["left", "left,left", "left,right", "left,straight", "first left", "second left"])
def test_right_mirrors_left(family, name):
    def mirror(text):
        return re.sub(r"\b(left|right)(?=s?\b)", lambda match: TURNS[match[0]], text)

    assert [mirror(sentence) for sentence in draw(family, name, 300)] == draw(family, mirror(name), 300)


@pytest.mark.parametrize("name", KEYWORDS)
def test_the_last_directions_of_a_correction_are_meant(name):
    """Without small talk, what follows a correction names the keyword's turns and no other."""
    repairs = [part.split("{")[0].strip(" ,") for part in read("families")["rambling"]["slots"]["repair"]]
    turns = {manoeuvre.name.lower() for manoeuvre in KEYWORDS[name].manoeuvres} - {"straight"}
    talk = [part.strip(" ,") for part in read("families")["rambling"]["slots"]["after"]]
    corrected = 0
    for sentence in draw("rambling", name, 1000):
        repair = next((repair for repair in repairs if repair in sentence), None)
        if repair is not None:
            said = sentence.split(repair, 1)[1]
            for piece in talk:
                said = said.replace(piece, "")
            assert set(normalise(said)) & TURNS.keys() == turns, sentence
            corrected += 1
    assert corrected > 50


def readings(word, misheard):
    """All that a slip may make of a crucial word, spaces apart."""
    letters = "abcdefghijklmnopqrstuvwxyz"
    cuts = [(word[:k], word[k:]) for k in range(1, len(word))]
    edits = {a + c + b[1:] for a, b in cuts for c in letters} | {a + c + b for a, b in cuts for c in letters}
    edits |= {a + b[1:] for a, b in cuts} | {a + b[1::-1] + b[2:] for a, b in cuts} | {word + c for c in letters}
    return edits | {word} | {"".join(normalise(other)) for other in misheard.get(word, [])}


@pytest.mark.parametrize("name", KEYWORDS)
def test_slips_leave_crucial_words_recognisable_and_in_order(name):
    table = read("families")["noise"]
    clean, rng = Sentences("heldout"), random.Random(0)
    for _ in range(500):
        sentence = clean.sample(name, rng)
        words = sentence.split()
        crucial = [word for word in words if word in table["crucial"]]
        garbled = slip(sentence, rng)
        assert garbled != sentence
        heard = normalise(garbled)
        pattern = ".*".join(
            "|".join(map(re.escape, sorted(readings(word, table["misheard"])))).join("()") for word in crucial
        )
        assert re.search(pattern, "".join(heard)), (sentence, heard)
        assert all(
            heard.count(word) <= words.count(word) for word in table["crucial"] if word not in ("one", "two", "once")
        )


def test_slips_are_one_to_three():
    rng = random.Random(0)
    for sentence, most in (("hang a left", 1), ("hang a left at the corner", 2), (" ".join(["hang"] * 12), 3)):
        words, counts = sentence.split(), set()
        for _ in range(300):
            heard = normalise(slip(sentence, rng))
            counts.add(sum(word not in words for word in heard))
            assert abs(len(heard) - len(words)) <= most
        # A cut makes two new words, one dropped or doubled none.
        assert 1 in counts
        assert max(counts) <= 2 * most


def test_sampling_depends_on_the_generator_alone():
    random.seed(0)
    state = random.getstate()
    for family in FAMILIES:
        assert draw(family, "left,right", 20) == draw(family, "left,right", 20)
        assert draw(family, "left,right", 20, seed=1) != draw(family, "left,right", 20)
    assert random.getstate() == state


def test_keyword_spellings_and_bad_input():
    assert draw("ambiguity", "(First, left)", 5) == draw("ambiguity", "first left", 5)
    with pytest.raises(ValueError, match="unknown keyword 'backwards'"):
        draw("noise", "backwards", 1)
    with pytest.raises(ValueError, match="unknown family 'test': use one of paraphrase, ambiguity, noise, rambling"):
        Families("test")
