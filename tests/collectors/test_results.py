"""Records of many trainings, and the page of them."""

import json

import pytest

from ldrl.collectors.paper import SUCCESS, TARGETS
from ldrl.collectors.results import FOUR_WAY, T_ONLY, Result, Results, measure, read_cells
from ldrl.collectors.results_page import results_page

SEGMENTER = {
    "details": {"training": "2 batches"},
    "rows": [
        {"town": town, "look": "clear", "iou": iou, "worst_view": 0.5}
        for town, iou in (("town1", 0.96), ("town2", 0.9))
    ],
}


def record(town, keyword="left", success=True, strict=False):
    return {"town": town, "keyword": keyword, "success": success, "strict_success": strict}


def rates(success, strict=0.0, types=("all",), towns=("town1", "town2")):
    return {
        town: {name: {"episodes": 8, "success": success, "strict_success": strict} for name in types} for town in towns
    }


def result(cell, seed=0, measured=None, began=0.0, seconds=60.0, **changes):
    values = {"command": f"make {cell}", "hardware": "abacus", "versions": "v1"} | changes
    return Result(cell, seed, began=began, seconds=seconds, rates=measured or rates(1.0), **values)


def row(page, *start):
    """The cells of the first table row that starts with these."""
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in page.splitlines() if line[:1] == "|"]
    return next(cells for cells in rows if cells[: len(start)] == list(start))


def section(page, title):
    return page.split(f"## {title}")[1].split("\n## ")[0]


def test_rates_by_hand():
    found = measure([record("town1"), record("town1", "left,left", False), record("town1", "left,right", strict=True)])
    assert found == {
        "town1": {
            "single": {"episodes": 1, "success": 1.0, "strict_success": 0.0},
            "double": {"episodes": 2, "success": 0.5, "strict_success": 0.5},
            "all": {"episodes": 3, "success": 0.666667, "strict_success": 0.333333},
        }
    }


def test_random_towns_are_one_town(monkeypatch):
    monkeypatch.setattr("ldrl.collectors.results._has_four_way", lambda town: town == "random-7")
    found = measure([record("random-3"), record("random-3"), record("random-7"), record("random-7", success=False)])
    assert list(found) == ["unseen"]
    assert {name: (of["episodes"], of["success"]) for name, of in found["unseen"].items()} == {
        "single": (4, 0.75),
        "all": (4, 0.75),
        T_ONLY: (2, 1.0),
        FOUR_WAY: (2, 0.5),
        "worst town": (2, 0.5),
    }


@pytest.mark.parametrize(("town", "kind"), [("random-0", FOUR_WAY), ("random-7", T_ONLY)])
def test_four_way_junctions_are_found(town, kind):
    assert set(measure([record(town)])["unseen"]) & {T_ONLY, FOUR_WAY} == {kind}


def test_success_kept_is_of_the_same_seed():
    results = Results(
        [
            result("gs-hih", 0, rates(0.8)),
            result("gs-hih", 1, rates(0.5)),
            result("gs-hih-noise", 1, rates(0.4)),
            result("gs-hih-noise", 2, rates(0.9)),
        ]
    )
    assert results.values("gs-hih-noise", "town2", "all", "kept") == [0.8]
    assert results.values("gs-hih-noise", "town2", "all", "success") == [0.4, 0.9]
    assert results.values("gs-hih-noise", "unseen", "all", "kept") == []


def test_saved_results_come_back_and_the_later_counts(tmp_path):
    old, new = result("gs-hi", 0, rates(0.1), began=5.0), result("gs-hi", 0, rates(0.2), began=6.0)
    for order in ([old, new], [new, old]):
        Results([*order, result("gs-hih", 1)]).save(tmp_path / "r.json")
        assert list(Results.load(tmp_path / "r.json")) == [new, result("gs-hih", 1)]
    assert (tmp_path / "r.json").read_text().count("\n") == 4  # a line each, so that git shows what is new
    assert list(Results.load(tmp_path / "none.json")) == []


@pytest.mark.parametrize("text", ["{", "7", "[1]", '[{"cell": "gs-hih"}]'])
def test_a_broken_file_is_named(tmp_path, text):
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(ValueError, match=r"r\.json holds no results .*; take it from git again"):
        Results.load(tmp_path / "r.json")


@pytest.mark.parametrize("made", ["{", "[]", '{"command": "c"}'])
def test_a_broken_cell_is_named(tmp_path, made):
    folder = tmp_path / "seed0" / "gs-hih"
    folder.mkdir(parents=True)
    (folder / "made.json").write_text(made)
    (folder / "report.json").write_text('{"episodes": []}')
    with pytest.raises(ValueError, match=r"gs-hih is no finished cell .*; delete it and run again"):
        read_cells(tmp_path)


def test_only_finished_cells_are_read(tmp_path):
    about = {"command": "c", "weights": [], "began": 1, "seconds": 2, "hardware": "h", "versions": "v"}
    for cell, files in (("whole", "mr"), ("made", "m"), ("reported", "r")):
        folder = tmp_path / "seed12" / cell
        folder.mkdir(parents=True)
        for file, content in (("made", about), ("report", {"episodes": [record("town2")]})):
            if file[0] in files:
                (folder / f"{file}.json").write_text(json.dumps(content))
    (found,) = read_cells(tmp_path)
    assert (found.cell, found.seed, found.command, found.seconds) == ("whole", 12, "c", 2)
    assert found.rates["town2"]["all"]["episodes"] == 1


def test_the_paper_is_quoted():
    page = results_page(Results(), [], SEGMENTER)
    assert row(page, "Hih, rgb", "ordinal")[2:] == ["-", "-", "0.813", "-", "-", "0.333", "0"]
    assert row(page, "single policy with history", "all")[4::3] == ["0.311", "0.225"]
    assert row(page, "Hi, ps", "all")[4::3] == ["0.973", "0.898"]
    assert row(section(page, "Misleading"), "H0", "double")[4::3] == ["0.758", "0.652"]


def test_mean_and_spread_by_hand():
    three = [result("rgb-hih", seed, rates(each, each / 2, ("double",))) for seed, each in enumerate((0.9, 0.8, 1.0))]
    page = results_page(Results(three), [], SEGMENTER)
    cells = ["0.900 (0.800 to 1.000)", "0.450 (0.400 to 0.500)"]
    assert row(page, "Hih, rgb", "double")[2:] == [*cells, "0.809", *cells, "0.439", "3"]
    assert "Seeds: 0, 1, 2." in page


def test_what_falls_short_is_said():
    some = [
        result("gs-hih", 0, rates(0.98, 0.98, ("double", "all"))),
        result("gs-hih-noise", 0, rates(0.96)),
        result("gs-single", 0, rates(0.28)),
    ]
    text = section(results_page(Results(some), [], SEGMENTER), "Where ours fall short")
    project, paper, lower, higher = text.split(":\n\n")[1:]
    assert [line for line in project.splitlines() if line.startswith("-")] == [
        "- Hih, gs, Town 1, all, success: 0.980, to reach is 1.000.",
        "- Hih, gs, Town 2, all, success: 0.980, to reach is 0.995.",
        "- road segmenter, Town 2, clear: 0.900, to reach is 0.950.",
    ]  # noise keeps 0.96 / 0.98 = 0.9796
    assert [line for line in paper.splitlines() if line.startswith("-")] == [
        "- Hih, gs, Town 1, double: 0.980, the paper's 1.000.",
        "- Hih, gs, Town 1, all: 0.980, the paper's 1.000.",
        "- Hih, gs, Town 2, double: 0.980, the paper's 0.986.",
    ]
    assert lower.splitlines()[0] == "- single policy, Town 1, all: 0.280, the paper's 0.288."
    assert higher.strip() == "- single policy, Town 2, all: 0.280, the paper's 0.197."


def test_targets_are_judged_by_the_mean():
    three = [result("gs-hih", seed, rates(each, 0.97)) for seed, each in enumerate((0.99, 1.0, 0.995))]
    text = section(results_page(Results(three), [], SEGMENTER), "What should be reached")
    assert row(text, "Hih, gs", "Town 2", "all", "success")[4:] == ["0.995 (0.990 to 1.000)", "0.995", "yes", "3"]
    assert row(text, "Hih, gs", "Town 1", "all", "strict success")[4:] == ["0.970 (0.970 to 0.970)", "0.980", "no", "3"]
    assert row(text, "Hih, ps", "Town 1", "all", "success")[4:] == ["-", "0.995", "-", "0"]
    assert row(text, "road segmenter", "Town 2", "worst look", "IoU")[4:] == ["0.900", "0.950", "no", "-"]
    assert len(TARGETS) + 2 == text.count("\n|") - 2
    text = section(results_page(Results(three[:2]), [], SEGMENTER), "What should be reached")
    assert row(text, "Hih, gs", "Town 2", "all", "success")[6:] == ["yes so far", "2"]


def test_time_by_the_clock_by_hand():
    some = [
        result("gs-hih", 0, began=1000.0, seconds=600.0),
        result("gs-hi", 0, began=1300.0, seconds=600.0, command="python x.py 'stages=[high_level]'"),
        result("gs-h0", 0, began=4000.0, seconds=60.0),
        result("gs-hih-unseen", 0, began=5000.0, seconds=6000.0),
    ]
    cells = ["gs-hih", "gs-hi", "gs-h0", "gs-nmc", "rgb-h0", "rgb-hih-night", "gs-hih-unseen"]
    text = section(results_page(Results(some), cells, SEGMENTER), "Time")
    assert "Seed 0, the paper's tables: 3 of 5 cells took 16 minutes by the clock, 21 added up." in text
    assert "Seed 0, looks and unseen towns: 1 of 2 cells took 100 minutes by the clock, 100 added up." in text
    assert row(text, "gs-hi")[1:] == ["10.0", "1"]
    assert row(text, "gs-nmc")[1:] == ["-", "0"]
    assert row(text, "rgb-h0")[1:] == ["-", "0"]
    assert "\npython x.py 'stages=[high_level]'\n" in text
    for seconds, missed in ((6180.0, False), (6300.0, True)):
        late = Results([*some, result("gs-nmc", 0, began=19000.0, seconds=seconds)])
        text = section(results_page(late, cells, SEGMENTER), "Where ours fall short")
        line = "- time, seed 0: 121 minutes by the clock for the paper's tables, to reach is 120."
        assert (line in text) == ("- time, seed 0" in text) == missed


def test_the_papers_figures_are_rates_in_both_towns():
    for towns in SUCCESS.values():
        assert towns["town1"].keys() == towns["town2"].keys()
        assert all(0 <= value <= 1 for types in towns.values() for value in types.values())
