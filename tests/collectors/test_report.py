import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ldrl.collectors.evaluation import Outcome
from ldrl.collectors.paper import SUCCESS, paper_success
from ldrl.collectors.report import (
    check_writable,
    keyword_table,
    replacing,
    summarise,
    table,
    to_markdown,
    write_json,
)
from ldrl.envs import Episode
from ldrl.modules import AgentConfig

ODD_IDS = ["", "a|b", "1\n2", "日本 🚗", "\ud800", "../x", "null", "a|b"]


def outcome(name="x", town="town1", keyword="left", instruction="turn left", *, success=True, strict=True, **changes):
    values = {
        "collision": False,
        "off_road": False,
        "wrong_lane": False,
        "finished": True,
        "stuck": False,
        "finish_distance": 1.0,
        "largest_gap": 0.5,
        "seconds": 10.0,
    }
    return Outcome(
        episode=Episode(name, town, keyword, instruction, (0.0, 0.0, 0.0), ((0.0, 0.0), (9.0, 0.0))),
        success=success,
        strict_success=strict,
        track=torch.zeros(3, 2),
        subtasks=torch.zeros(3, dtype=torch.int64),
        **(values | changes),
    )


@pytest.fixture
def outcomes():
    return [
        outcome("b", "town2", "left,right", success=False, strict=False, collision=True),
        outcome("a", "town1", "left"),
        outcome("c", "town1", "left", strict=False, off_road=True),
        outcome("d", "town1", "second left", success=False, strict=False, stuck=True, finish_distance=None),
    ]


def cells(markdown, *start):
    """The cells of the one table row that starts with these."""
    rows = [[cell.strip() for cell in line.split(" | ")] for line in markdown.splitlines() if line.startswith("| ")]
    rows = [[cell.strip("| ") for cell in row] for row in rows]
    found = [row for row in rows if row[: len(start)] == list(start)]
    assert len(found) == 1, (start, rows)
    return found[0][len(start) :]


def test_summary_counts_per_town_type_and_keyword(outcomes):
    summary = summarise(outcomes)
    assert {name: summary[name] for name in ("episodes", "success", "strict_success", "stuck")} == {
        "episodes": 4,
        "success": 0.5,
        "strict_success": 0.25,
        "stuck": 1,
    }
    town1 = summary["towns"]["town1"]
    assert (town1["episodes"], town1["success"], town1["strict_success"], town1["stuck"]) == (3, 0.666667, 0.333333, 1)
    assert town1["types"] == {
        "single": {"episodes": 2, "success": 1.0, "strict_success": 0.5, "stuck": 0},
        "ordinal": {"episodes": 1, "success": 0.0, "strict_success": 0.0, "stuck": 1},
    }
    assert town1["keywords"] == {"left": town1["types"]["single"], "second left": town1["types"]["ordinal"]}
    assert list(summary["towns"]["town2"]["keywords"]) == ["left,right"]


def test_no_outcome_has_no_rate():
    assert summarise([]) == {"episodes": 0, "success": None, "strict_success": None, "stuck": 0, "towns": {}}
    assert "0 episodes" in to_markdown([])


def test_json_keeps_order_and_ids(tmp_path):
    outcomes = [outcome(name, ("town2", "town1")[k % 2]) for k, name in enumerate(ODD_IDS)]
    path = tmp_path / "report.json"
    path.write_text("old")
    write_json(outcomes, path)
    report = json.loads(path.read_text(encoding="utf-8"))
    assert [record["id"] for record in report["episodes"]] == ODD_IDS
    assert report["episodes"][1] == outcomes[1].record()
    assert report["summary"] == summarise(outcomes)
    assert list(tmp_path.iterdir()) == [path]


def test_a_reader_of_the_old_file_is_not_disturbed(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    with path.open() as reader:
        write_json([outcome()], path)
        assert reader.read() == "old"


def test_json_has_no_nan(tmp_path):
    write_json([outcome(largest_gap=math.nan, seconds=math.inf)], tmp_path / "report.json")
    report = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["episodes"][0]["largest_gap"] is None
    assert report["episodes"][0]["seconds"] is None
    assert report["episodes"][0]["finish_distance"] == 1.0


@pytest.mark.parametrize("name", ["missing/report.json", "file/report.json", "folder", "n" * 300])
def test_unwritable_path_is_an_error_that_names_it(tmp_path, name):
    (tmp_path / "file").write_text("a file, not a folder")
    (tmp_path / "folder").mkdir()
    for write in (check_writable, lambda path: write_json([outcome()], path)):
        with pytest.raises(OSError, match=r"cannot write .*name a file in a folder") as error:
            write(tmp_path / name)
        assert str(tmp_path / name) in str(error.value)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


def test_a_device_is_not_replaced():
    with pytest.raises(OSError, match="no regular file"):
        write_json([outcome()], "/dev/null")
    assert Path("/dev/null").is_char_device()


def test_check_writable_changes_nothing(tmp_path):
    path = tmp_path / "report.json"
    check_writable(path)
    assert not list(tmp_path.iterdir())
    path.write_text("old")
    check_writable(path)
    assert path.read_text() == "old"


def test_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")

    def write():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_table_stands_beside_the_papers_figures(outcomes):
    text = table(outcomes, SUCCESS["gs-hih"])
    assert cells(text, "town1", "single") == ["2", "1.000", "0.500", "0", "1.000"]
    assert cells(text, "town1", "all") == ["3", "0.667", "0.333", "1", "1.000"]
    assert cells(text, "town2", "double") == ["1", "0.000", "0.000", "0", "0.986"]
    assert cells(text, "town2", "all")[-1] == "0.970"
    assert "double" not in "".join(line for line in text.splitlines() if "town1" in line)
    assert len({len(line) for line in text.splitlines()}) == 1
    assert text in to_markdown(outcomes, paper=SUCCESS["gs-hih"])


def test_other_towns_have_no_figure_in_the_paper():
    assert cells(table([outcome(town="elsewhere")], SUCCESS["gs-hih"]), "elsewhere", "all")[-1] == "-"
    assert cells(table([outcome()]), "town1", "all")[-1] == "-"


def test_the_papers_figures_are_of_the_same_model_on_the_same_input():
    assert paper_success(AgentConfig())["town2"] == {"single": 1.0, "double": 0.986, "ordinal": 0.938, "all": 0.97}
    assert paper_success(AgentConfig(modality="rgb"))["town2"]["ordinal"] == 0.333
    assert paper_success(AgentConfig(), misleading=True)["town2"]["double"] == 0.928
    assert paper_success(AgentConfig(model="hihg", modality="rgb")) == {}


def test_keyword_table_has_the_towns_side_by_side(outcomes):
    text = to_markdown(outcomes).split("## Per keyword")[1].split("##")[0]
    # Town 2 comes first, as in the outcomes.
    assert cells(text, "left") == ["single", "0", "-", "-", "2", "1.000", "0.500"]
    assert cells(text, "left,right") == ["double", "1", "0.000", "0.000", "0", "-", "-"]
    assert "right,right" not in text


@pytest.mark.parametrize(
    ("changes", "happened"),
    [
        ({"collision": True}, "collision"),
        ({"off_road": True}, "off the road"),
        ({"wrong_lane": True}, "in an oncoming lane"),
        ({"largest_gap": 31.24}, "missed the path by 31.2 m"),
        ({"largest_gap": math.nan}, "missed the path by nan m"),
        ({"finished": False, "finish_distance": None}, "did not declare finish"),
        ({"finished": False, "finish_distance": None, "stuck": True}, "stuck"),
        ({"finish_distance": 15.01}, "declared finish 15.0 m from the end of the path"),
        (
            {"collision": True, "wrong_lane": True, "largest_gap": 10.1},
            "collision; in an oncoming lane; missed the path by 10.1 m",
        ),
    ],
)
def test_report_says_what_happened(changes, happened):
    text = to_markdown([outcome("bad", success=False, strict=False, **changes), outcome("good")])
    assert cells(text, "bad") == ["turn left", "no", happened]
    assert "good" not in text
    assert "Episodes without strict success: 1" in text


def test_report_says_who_drove_on():
    def drove_on(**changes):
        bad = outcome("bad", success=False, strict=False, **changes)
        return cells(to_markdown([replace(bad, episode=replace(bad.episode, stop=True))]), "bad")[2]

    assert drove_on() == "did not stop at the end of the path"
    assert drove_on(collision=True) == "collision"
    assert drove_on(largest_gap=12.0) == "missed the path by 12.0 m"


def test_report_counts_the_stuck(outcomes):
    assert "4 episodes, one drive each; 1 of them ended stuck" in to_markdown(outcomes)


def test_all_went_well():
    assert "Episodes without strict success: 0\n\nNone." in to_markdown([outcome()])


def test_hostile_texts_stay_in_their_cells():
    text = to_markdown(
        [outcome(name, instruction="<b>*go*\n| now", success=False, strict=False) for name in ODD_IDS]
        + [outcome("long", instruction="left " * 5000, success=False, strict=False)],
        title="a\n# b",
        details={"seed": "0|1"},
    )
    text.encode("utf-8")
    rows = [line for line in text.split("what happened")[1].splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + len(ODD_IDS) + 1 + 3  # rules, episodes, the long one, the details
    assert text.count(r"\<b\>\*go\* \| now") == len(ODD_IDS)
    assert r"a\|b" in text
    assert "# a # b" in text
    assert max(map(len, text.splitlines())) < 400
    assert cells(text, "seed") == [r"0\|1"]


def test_many_towns_are_taken_together():
    some = [outcome(str(k), f"random-{k}", success=k > 0, strict=k > 1) for k in range(5)]
    assert cells(table(some[:4]), "random-3", "all")[:3] == ["1", "1.000", "1.000"]
    assert cells(table(some), "5 towns", "all")[:3] == ["5", "0.800", "0.600"]
    assert "5 towns success" in keyword_table(some)
