"""The segmenter's recipe, run as a user runs it, on a small town in place of random ones."""

import json
import runpy
import sys
from pathlib import Path

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from safetensors.torch import load_file

from ldrl.envs import RoadSegmenter
from ldrl.envs.appearance import WEATHERS
from ldrl.towns import Town

RECIPE = Path(__file__).parents[2] / "recipes" / "train_segmenter.py"
BRIEF = ("steps=2", "batch=3", "towns=2", "frames=2", "network.depth_multiplier=0.1")


@pytest.fixture
def call(monkeypatch, capsys, tmp_path, towns, square):
    """Runs the recipe; returns what it printed, its error if it exits with one, and the names of its random towns."""
    asked = []
    monkeypatch.setattr(Town, "load", lambda name: towns[name] if name in towns else asked.append(name) or square)
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", [str(RECIPE), *arguments])
        error = None
        try:
            runpy.run_path(str(RECIPE), run_name="__main__")
        except SystemExit as exit_:
            error = exit_.code
        finally:
            GlobalHydra.instance().clear()
        return capsys.readouterr().out, error, asked

    return call


def test_trains_on_random_towns_and_measures_the_built_in_ones(call, tmp_path):
    out, error, asked = call(*BRIEF, "name=brief")
    assert error is None
    assert asked == ["random-10000", "random-10001"]
    folder = tmp_path / "runs" / "brief"
    names = ["config.json", "model.safetensors", "preprocessor_config.json", "report.json", "report.md", "views.png"]
    assert sorted(path.name for path in folder.iterdir()) == names
    report = json.loads((folder / "report.json").read_text())
    looks = (*WEATHERS, "sample", "sample, cars")
    assert [(row["town"], row["look"]) for row in report["rows"]] == [(t, k) for t in ("town1", "town2") for k in looks]
    assert all(0 <= row["worst_view"] <= row["iou"] <= 1 for row in report["rows"])
    assert "| sunset " in out
    assert "| sunset " in (folder / "report.md").read_text()
    assert RoadSegmenter(folder).segment(torch.zeros(3, 88, 200, dtype=torch.uint8)).shape == (1, 88, 200)

    call(*BRIEF, "name=again")
    call(*BRIEF, "name=other", "seed=1")
    weights, again, other = (
        load_file(tmp_path / "runs" / name / "model.safetensors") for name in ("brief", "again", "other")
    )
    assert all(torch.equal(weights[key], again[key]) for key in weights)
    assert any(not torch.equal(weights[key], other[key]) for key in weights)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("frames=0", "frames is 0; give a whole number of at least 1"),
        ("first_town=abc", "first_town is 'abc'; give a whole number of at least 0"),
        ("first_row=88", "first_row is 88; give a row of the image, 0 to 87"),
        ("input_size=[44]", "input_size is [44]; give rows and columns, such as [44,100]"),
        ("device=moon", "moon"),
    ],
)
def test_bad_arguments(call, tmp_path, argument, message):
    _, error, asked = call(*BRIEF, argument)
    assert str(error).startswith("error: ")
    assert message in error
    assert not asked
    assert not list(tmp_path.iterdir())


def test_without_transformers(call, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    _, error, asked = call(*BRIEF)
    assert "transformers" in error
    assert not asked
