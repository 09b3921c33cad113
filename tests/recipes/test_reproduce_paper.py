"""The paper's tables with recipes that only pretend to train: what is run, in which order, and what is not."""

import json
import re
import runpy
import shlex
import shutil
import signal
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from ldrl.collectors import results_page
from ldrl.collectors.paper import SUCCESS, TARGETS
from ldrl.collectors.results import Results
from ldrl.envs.appearance import appearance_number
from ldrl.envs.segmenter import SHIPPED
from ldrl.modules import AgentConfig
from ldrl.towns import Town

RECIPES = Path(__file__).parents[2] / "recipes"
CONFIG = yaml.safe_load((RECIPES / "config" / "reproduce_paper.yaml").read_text())
EVERYTHING = f"tables=[{','.join(CONFIG['contents'])}]"
FAKE = '''
"""Logs its arguments, and writes what a recipe writes."""
import json, os, sys
from pathlib import Path
given = dict(argument.split("=", 1) for argument in sys.argv[1:])
print("driven with", os.environ["OMP_NUM_THREADS"], os.environ["MALLOC_MMAP_MAX_"])
folder = Path(given["out"]).parent if "out" in given else Path("runs", given["name"])
with open("calls.txt", "a") as calls:
    calls.write(f"{folder.parent.name}/{folder.name}\\n")
if folder.name == os.environ.get("BROKEN"):
    (folder / "report.json").write_text("cut o")
    sys.exit("error: the moon is down")
folder.mkdir(parents=True, exist_ok=True)
if folder.name == os.environ.get("EDITED"):
    with Path(sys.argv[0]).with_name("config").joinpath("preset", "full.yaml").open("a") as preset:
        preset.write("learning_rate: 1\\n")
if "out" not in given:
    (folder / "agent.safetensors").write_text(" ".join(sys.argv[1:]) + os.environ.get("WEIGHTS", ""))
    if "start_from.demonstrations" not in given:
        (folder / "demonstrations").mkdir(exist_ok=True)
records = [
    {"town": town, "keyword": keyword, "success": good, "strict_success": False}
    for town in ("town1", "town2") for keyword, good in (("left", True), ("left,left", town == "town1"))
]
(folder / "report.json").write_text(json.dumps({"episodes": records}))
'''


@pytest.fixture
def reproduce(tmp_path, monkeypatch, capsys):
    """Runs the recipe in an empty folder on pretending recipes: what was made in order, its error, what it printed."""
    fakes = tmp_path / "recipes"
    shutil.copytree(RECIPES / "config", fakes / "config")
    shutil.copy(RECIPES / "reproduce_paper.py", fakes)
    for name in ("bc_hierarchical.py", "evaluate.py"):
        (fakes / name).write_text(FAKE)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")

    def reproduce(*arguments):
        monkeypatch.setattr(sys, "argv", [str(fakes / "reproduce_paper.py"), *arguments])
        calls, error = Path("calls.txt"), None
        calls.write_text("")
        try:
            runpy.run_path(str(fakes / "reproduce_paper.py"), run_name="__main__")
        except SystemExit as exit_:
            error = exit_.code
        finally:
            GlobalHydra.instance().clear()
        return calls.read_text().split(), error, "".join(capsys.readouterr())

    handler = signal.getsignal(signal.SIGTERM)  # the recipe sets one
    yield reproduce
    signal.signal(signal.SIGTERM, handler)


def test_every_cell_once_and_after_what_it_needs(reproduce):
    made, error, printed = reproduce(EVERYTHING)
    assert error is None, printed
    assert sorted(made) == sorted(f"seed0/{cell}" for cell in CONFIG["cells"])
    for cell, given in CONFIG["cells"].items():
        for needed in [given["checkpoint"]] if "checkpoint" in given else given.get("start_from", {}).values():
            assert made.index(f"seed0/{needed}") < made.index(f"seed0/{cell}")
    assert re.match(r"driven with \d+ 0\n", Path("runs/paper/seed0/gs-hih/output.txt").read_text())


def test_only_what_a_table_needs(reproduce):
    needed = ("gs-low", "reader", "gs-hih", "gs-hih-unseen")
    assert reproduce("tables=[unseen]", "seeds=[3,1]", "jobs=1")[0] == [
        f"seed{k}/{cell}" for k in (3, 1) for cell in needed
    ]
    assert reproduce("tables=[]")[0] == []


def test_a_command_is_one_that_a_user_can_type(reproduce):
    reproduce(EVERYTHING)
    commands = {path.parent.name: json.loads(path.read_text())["command"] for path in Path("runs").rglob("made.json")}
    assert commands["rgb-h0"] == (
        "python recipes/bc_hierarchical.py name=paper/seed0/rgb-h0 seed=0 preset=full "
        "'stages=[]' model=h0 modality=rgb start_from.low_level=runs/paper/seed0/rgb-low "
        "start_from.high_level=runs/paper/seed0/gs-h0"
    )
    assert commands["gs-hih-unseen"] == (
        "python recipes/evaluate.py checkpoint=runs/paper/seed0/gs-hih episodes=unseen "
        "out=runs/paper/seed0/gs-hih-unseen/report.json"
    )
    # What starts from one that has learned much the same is trained for less long.
    trained = {name for name, command in commands.items() if "stages=" in command and "stages=[]" not in command}
    whole = {name for name in trained if "_steps" not in commands[name]}
    assert whole == {"gs-low", "reader", "gs-hih", "gs-h0"}
    assert "language_steps=1000 high_level_steps=300" in commands["gs-nmc"]
    assert " drives_steps=100 " in commands["gs-single"]
    assert " low_level_steps=1200 " in commands["rgb-low"]


@pytest.mark.parametrize("scale", CONFIG["scales"])
def test_the_recipes_take_the_commands(reproduce, scale):
    """What the pretending recipes take, the real ones take too."""
    _, error, _ = reproduce(f"scale={scale}", EVERYTHING)
    assert error is None
    commands = [json.loads(path.read_text())["command"] for path in Path("runs").rglob("made.json")]
    assert len(commands) == len(CONFIG["cells"])
    assert CONFIG["scales"][scale]["cells"].keys() <= CONFIG["cells"].keys()
    with initialize_config_dir(str(RECIPES / "config"), version_base="1.3"):
        for command in commands:
            recipe, *arguments = shlex.split(command)[1:]
            cfg = compose(Path(recipe).stem, overrides=arguments)
            if "bc_hierarchical" in recipe:
                runpy.run_path(str(RECIPES / "bc_hierarchical.py"))["check"](cfg)
                AgentConfig(model=cfg.model, modality=cfg.modality, **cfg.size)


def test_a_finished_cell_is_not_made_again(reproduce):
    reproduce("tables=[models]")
    assert reproduce("tables=[models]")[0] == []
    assert sorted(reproduce("tables=[models,unseen]")[0]) == ["seed0/gs-hih-unseen"]


def test_a_cell_that_lost_a_file_is_made_again(reproduce):
    reproduce("tables=[unseen]")
    for lost in ("gs-hih-unseen/made.json", "gs-hih-unseen/report.json", "gs-hih/agent.safetensors"):
        Path("runs/paper/seed0", lost).unlink()
        assert reproduce("tables=[unseen]")[0] == [f"seed0/{Path(lost).parent}"]
    Path("runs/paper/seed0/gs-low/demonstrations").rmdir()
    assert reproduce("tables=[unseen]")[0] == ["seed0/gs-low"]


def test_a_cell_whose_command_changed_is_made_again_with_what_starts_from_it(reproduce, monkeypatch):
    reproduce("tables=[misleading]", "jobs=1")
    changed = ("tables=[misleading]", "jobs=1", "+cells.gs-hi.high_level_steps=7")
    made, error, printed = reproduce(*changed)
    assert error is None
    assert made == ["seed0/gs-hi", "seed0/gs-hi-misleading"]
    assert "seed0/gs-hi: other command than before, so it is made again" in printed
    assert "seed0/gs-hi-misleading: other weights than before, so it is made again" in printed
    assert reproduce(*changed)[0] == []


def test_settings_that_change_under_way_are_not_what_a_cell_was_made_with(reproduce, monkeypatch):
    monkeypatch.setenv("EDITED", "reader")
    reproduce("tables=[unseen]")
    monkeypatch.delenv("EDITED")
    made, _, printed = reproduce("tables=[unseen]")
    assert sorted(made) == ["seed0/gs-low", "seed0/reader"]
    assert "seed0/reader: other settings than before, so it is made again" in printed


def test_cells_on_ps_are_made_again_with_another_segmenter(reproduce, monkeypatch, tmp_path):
    reproduce("tables=[input]")
    folder = tmp_path / "road-segmenter"
    shutil.copytree(SHIPPED / "road-segmenter", folder)
    (folder / "model.safetensors").write_bytes(b"other")
    monkeypatch.setattr("ldrl.envs.segmenter.SHIPPED", tmp_path)
    made, _, _ = reproduce("tables=[input]")
    assert sorted(made) == [f"seed0/ps-{model}" for model in ("h0", "hi", "hih")]


def test_the_same_weights_again_leave_what_starts_from_them(reproduce):
    reproduce("tables=[unseen]")
    Path("runs/paper/seed0/gs-hih/made.json").unlink()
    assert reproduce("tables=[unseen]")[0] == ["seed0/gs-hih"]


def test_a_failure_stops_the_run(reproduce, monkeypatch):
    monkeypatch.setenv("BROKEN", "gs-hi")
    made, error, printed = reproduce("tables=[misleading]", "jobs=1")
    assert error == "error: seed0/gs-hi failed; run the same again to go on from here"
    assert made[-1] == "seed0/gs-hi"
    assert "error: the moon is down" in printed
    assert {f"seed0/{result.cell}" for result in Results.load("docs/results.json")} == set(made[:-1])
    monkeypatch.delenv("BROKEN")
    assert reproduce("tables=[misleading]", "jobs=1")[0][0] == "seed0/gs-hi"


def test_results_outlive_the_runs(reproduce):
    reproduce("tables=[unseen]", "seeds=[0]")
    first = Path("docs/results.json").read_text()
    Path("runs/paper").rename("gone")
    reproduce("tables=[]")
    assert Path("docs/results.json").read_text() == first
    reproduce("tables=[unseen]", "seeds=[1]")
    assert Results.load("docs/results.json").seeds == [0, 1]
    assert "Seeds: 0, 1." in Path("docs/results.md").read_text()


def test_smoke_leaves_the_page_alone(reproduce):
    made, error, printed = reproduce("scale=smoke", "tables=[unseen]")
    assert error is None, printed
    assert sorted(made) == [f"seed0/{cell}" for cell in ("gs-hih", "gs-hih-unseen", "gs-low", "reader")]
    assert not Path("docs").exists()
    assert Path("runs/paper-smoke/results.md").read_text().startswith("# Results")
    command = json.loads(Path("runs/paper-smoke/seed0/gs-hih-unseen/made.json").read_text())["command"]
    assert command.endswith("routes_per_keyword=1 unseen_towns=1")


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("tables=[input,output]", "tables has 'output'; use some of input, models, misleading, language, appear"),
        ("scale=huge", "scale has 'huge'; use some of full, smoke"),
        ("jobs=0", "jobs is 0; give whole numbers of at least 1"),
        ("seeds=[-1]", "seeds is [-1]; give whole numbers of at least 0"),
        ("seeds=[0,0]", "seeds is [0, 0]; give each seed once"),
        ("seeds=1", "seeds is 1; give a list, such as seeds=[1]"),
        ("tables=input", "tables is 'input'; give a list, such as tables=[input]"),
    ],
)
def test_bad_arguments(reproduce, argument, message):
    made, error, _ = reproduce(argument)
    assert message in error
    assert made == []


def test_one_look_is_town_1s_own():
    number = appearance_number(Town.load("town1").scenery.seed, "clear")
    assert [CONFIG["cells"][cell]["appearance"] for cell in ("rgb-low-clear", "rgb-hih-clear")] == [number, number]


def test_later_seeds_need_what_the_first_needs(reproduce):
    reproduce("tables=[models]", "seeds=[0,1]")
    assert reproduce("tables=[models]", "seeds=[1]")[0] == []


def test_the_page_has_a_place_for_every_cell():
    evaluated = {cell for cell, given in CONFIG["cells"].items() if given.get("episodes_per_keyword") != 0}
    shown = {
        cell
        for rows in ("FULL", "MODELS", "EVERY", "MISLEADING", "POSSIBLE", "LOOKS", "FAMILIES")
        for cell in getattr(results_page, rows).values()
    }
    assert shown | {"gs-hih-unseen"} == evaluated
    assert set(SUCCESS) | {target.cell for target in TARGETS} <= set(CONFIG["cells"])
    assert {cell for cells in CONFIG["contents"].values() for cell in cells} == evaluated
