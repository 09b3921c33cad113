import itertools
import random

import pytest

from ldrl.language.keywords import KEYWORDS, SAFE_KEYWORDS, Keyword, realised_by
from ldrl.subtasks import MANOEUVRES, SubTask

L, R, S = MANOEUVRES
F = SubTask.FINISH
OPTIONS = [set(some) for size in (1, 2, 3) for some in itertools.combinations(MANOEUVRES, size)]


def walk(keyword, options):
    """The manoeuvres asked for at these junctions until the keyword is done; None where one does not allow it."""
    state, manoeuvres = keyword.start, []
    for offered in options:
        if keyword.done(state):
            break
        decision = keyword.step(state, offered)
        if decision is None:
            return None
        manoeuvre, state = decision
        manoeuvres.append(manoeuvre)
    return manoeuvres if keyword.done(state) else None


def test_the_14_keywords_in_the_order_of_the_paper():
    assert list(KEYWORDS) == [
        *("left", "right", "straight"),
        *("left,left", "left,right", "left,straight", "right,left", "right,right", "right,straight"),
        *("straight,straight", "first left", "first right", "second left", "second right"),
    ]
    assert [keyword.type for keyword in KEYWORDS.values()] == ["single"] * 3 + ["double"] * 7 + ["ordinal"] * 4
    assert all(keyword.name == name for name, keyword in KEYWORDS.items())


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("left", "left"),
        (" Straight\n", "straight"),
        ("(First, left)", "first left"),
        ("first,left", "first left"),
        ("SECOND_RIGHT", "second right"),
        ("left right", "left,right"),
        ("left_right", "left,right"),
        ("('straight', 'straight')", "straight,straight"),
    ],
)
def test_parse_normalises(spelling, name):
    assert Keyword.parse(spelling) is KEYWORDS[name]
    assert Keyword.parse(KEYWORDS[name]) is KEYWORDS[name]


@pytest.mark.parametrize("spelling", ["", "()", "lefft", "third left", "straight,left", "leftright", "left1right"])
def test_parse_names_the_unknown_value_and_all_keywords(spelling):
    with pytest.raises(ValueError, match="unknown keyword") as error:
        Keyword.parse(spelling)
    assert repr(spelling) in str(error.value)
    assert all(f"'{name}'" in str(error.value) for name in KEYWORDS)


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("left", [{L, S}], [L]),
        ("left", [{R, S}], None),
        ("straight", [{L, R}], None),
        ("left,right", [{L, S}, {L, R, S}], [L, R]),
        ("left,right", [{L, S}, {L, S}], None),
        ("left,right", [{R, S}, {L, R}], None),
        ("first left", [{L, R}], [L]),
        ("first left", [{R, S}, {R, S}, {L, S}], [S, S, L]),
        ("second left", [{L, S}, {R, S}, {L, R}], [S, S, L]),
        ("second left", [{R, S}, {L, S}, {R, S}, {L, R}], [S, S, S, L]),
        ("second left", [{L, R}, {L, S}], None),
        ("second right", [{R, S}, {L, R, S}], [S, R]),
        ("first right", [{L, S}, {L}], None),
        ("second right", [{R, S}, {L, S}], None),
    ],
)
def test_automaton_by_hand(name, options, expected):
    assert walk(KEYWORDS[name], options) == expected


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("left", [{L, R}], [L]),
        ("left", [{R, S}], [S]),
        ("left", [{R}], [F]),
        ("straight", [{L, R}], [F]),
        ("left,right", [{R, S}, {L, R}], [S, R]),
        ("left,right", [{L, R}, {L, S}], [L, S]),
        ("left,right", [{R, S}, {L, S}], [S, S]),
        ("left,straight", [{L, S}, {L, R}], [L, F]),
        ("left,straight", [{R, S}, {L, R}], [S, F]),
        ("straight,straight", [{L, R}, {L, S}], [F]),
        ("straight,straight", [{L, S}, {L, R}], [S, F]),
    ],
)
def test_safe_answers_by_hand(name, options, expected):
    assert walk(SAFE_KEYWORDS[name], options) == expected


def test_safe_keywords_do_what_is_said_where_they_can():
    assert list(SAFE_KEYWORDS) == [name for name, keyword in KEYWORDS.items() if keyword.type != "ordinal"]
    for name, safe in SAFE_KEYWORDS.items():
        for options in itertools.product(OPTIONS, repeat=2):
            asked, done = walk(KEYWORDS[name], options), walk(safe, options)
            assert done == asked or (asked is None and (S in done or done[-1] == F))
            assert safe in realised_by(done, options[: len(done)], SAFE_KEYWORDS.values())
            assert (KEYWORDS[name] in realised_by(done, options[: len(done)])) == (asked is not None)


def test_second_left_counts_only_streets_on_the_left():
    keyword = KEYWORDS["second left"]
    assert keyword.step(0, {R, S}) == (S, 0)
    assert keyword.step(0, {L, S}) == (S, 1)
    assert keyword.step(1, {L, R}) == (L, 2)
    assert [keyword.done(state) for state in (0, 1, 2)] == [False, False, True]


@pytest.mark.parametrize("name", ["left", "straight,straight", "second right"])
def test_a_keyword_that_is_done_asks_for_nothing(name):
    keyword = KEYWORDS[name]
    with pytest.raises(ValueError, match=f"'{name}' is done in state {keyword.count}"):
        keyword.step(keyword.count, {L, R, S})


@pytest.mark.parametrize(
    ("manoeuvres", "options", "names"),
    [
        ([S, L], [{S, R}, {L, S}], ["first left"]),
        ([S, L], [{S, L}, {L, S}], ["second left"]),
        ([S, L], [{S, L}, {R, S}], []),
        ([L], [{L, R}], ["left", "first left"]),
        ([S], [{L, S}], ["straight"]),
        ([L, L], [{L, S}, {L, S}], ["left,left"]),
        ([S, S], [{L, S}, {R, S}], ["straight,straight"]),
        ([S, R], [{R, S}, {L, R, S}], ["second right"]),
        ([S, S, R], [{L, S}, {R, S}, {R, S}], ["second right"]),
        ([SubTask.LANEFOLLOW], [{L, R, S}], []),
        ([], [], []),
    ],
)
def test_realised_by_by_hand(manoeuvres, options, names):
    assert [keyword.name for keyword in realised_by(manoeuvres, options)] == names


def test_realised_by_is_what_the_automaton_drives():
    rng = random.Random(0)
    for _ in range(2000):
        options = rng.choices(OPTIONS, k=rng.randint(1, 4))
        manoeuvres = [rng.choice(sorted(offered)) for offered in options]
        expected = [keyword for keyword in KEYWORDS.values() if walk(keyword, options) == manoeuvres]
        assert realised_by(manoeuvres, options) == expected


def test_ordinals_against_counting_the_streets():
    for name, turn, nth in [("first left", L, 1), ("second left", L, 2), ("first right", R, 1), ("second right", R, 2)]:
        for options in itertools.product(OPTIONS, repeat=3):
            streets = [index for index, offered in enumerate(options) if turn in offered]
            found = len(streets) >= nth and all(S in offered for offered in options[: streets[nth - 1]])
            expected = [S] * streets[nth - 1] + [turn] if found else None
            assert walk(KEYWORDS[name], options) == expected


def test_realised_by_wants_options_for_each_manoeuvre():
    with pytest.raises(ValueError, match="1 manoeuvres at 2 junctions"):
        realised_by([L], [{L}, {L}])
