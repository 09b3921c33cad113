"""Both recipes, run as a user runs them, and every way in which their input can be bad."""

import csv
import json
import math
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn
from torchrl.record import CSVLogger

from ldrl.collectors import BoundarySampler
from ldrl.envs import DashCamera, builtin_episodes, save_episodes
from ldrl.language import KEYWORDS
from ldrl.modules import AgentConfig, load_agent
from ldrl.towns import Town

MAP = Path(__file__).parents[1] / "towns" / "theta.xodr"
RECIPES = Path(__file__).parents[2] / "recipes"
TINY = ("size.conv_channels=[2,3,4]", "size.features=8", "size.low_level_hidden=6", "size.high_level_hidden=7")
TOWNS = ("town1", "town2")
BRIEF = ("preset=smoke", "low_level_steps=2", "high_level_steps=2", "batch_slices=4", "batch_sequences=4")


def start(recipe, *arguments, cwd):
    return subprocess.run(
        [sys.executable, "-W", "ignore", str(RECIPES / recipe), *arguments],
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Where ``bc_hierarchical.py`` has run, and what it printed."""
    cwd = tmp_path_factory.mktemp("train")
    done = start("bc_hierarchical.py", *BRIEF, *TINY, "name=brief", "towns=[town1,random-1002-12]", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd, done


@pytest.fixture
def call(monkeypatch, capsys, towns):
    """Runs a recipe in this process; returns what it printed, and its error if it exits with one."""
    load = Town.load
    monkeypatch.setattr(Town, "load", lambda name: towns[name] if name in towns else load(name))  # compiled once

    def call(recipe, *arguments, cwd):
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", [str(RECIPES / recipe), *arguments])
        error = None
        try:
            runpy.run_path(str(RECIPES / recipe), run_name="__main__")
        except SystemExit as exit_:
            error = exit_.code
        finally:
            GlobalHydra.instance().clear()
        return "".join(capsys.readouterr()), error

    return call


@pytest.fixture
def some(episodes):
    """A few short episodes of both towns, with odd ids."""
    chosen = [sorted(episodes[name], key=lambda e: len(e.path))[k] for k in (0, 3) for name in ("town2", "town1")]
    ids = ["b", "a|b\n🚗", "", "b"]
    return [type(e)(**{**vars(e), "id": name}) for e, name in zip(chosen, ids, strict=True)]


def test_everything_is_written(trained):
    cwd, done = trained
    folder = cwd / "runs" / "brief"
    assert [path.name for path in cwd.iterdir()] == ["runs"]
    assert {path.name for path in folder.iterdir()} == {
        "agent.json",
        "agent.safetensors",
        "config.yaml",
        "demonstrations",
        "log",
        "losses.png",
        "report.json",
        "report.md",
        "tracks_town1.png",
        "tracks_town2.png",
    }
    assert {path.name for path in (folder / "demonstrations").iterdir()} == {"town1", "random-1002-12"}
    for picture in folder.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    assert "runs/brief" in done.stdout
    assert "strict success" in done.stdout
    for stage in ("low level", "high level", "evaluation"):  # progress bars with the time left
        assert re.search(rf"{stage}: 100%.*<", done.stderr)


def test_the_checkpoint_is_the_config(trained):
    cwd, _ = trained
    agent = load_agent(cwd / "runs" / "brief")
    config = yaml.safe_load((cwd / "runs" / "brief" / "config.yaml").read_text())
    assert agent.config == AgentConfig(**config["size"])
    assert agent.config.conv_channels == (2, 3, 4)
    assert config["low_level_steps"] == 2


def test_the_report_has_every_episode(trained, episodes):
    cwd, _ = trained
    report = json.loads((cwd / "runs" / "brief" / "report.json").read_text())
    found = [(record["town"], record["keyword"]) for record in report["episodes"]]
    assert found == [(town, keyword) for town in ("town1", "town2") for keyword in KEYWORDS]  # one of each
    assert {record["id"] for record in report["episodes"]} <= {e.id for some in episodes.values() for e in some}
    assert report["summary"]["episodes"] == 28
    markdown = (cwd / "runs" / "brief" / "report.md").read_text()
    assert markdown.startswith("# brief\n")
    assert "paper" in markdown


def test_losses_are_logged(trained):
    cwd, _ = trained
    logs = {path.stem: path for path in (cwd / "runs" / "brief" / "log").rglob("*.csv")}
    assert {"loss_keyword", "loss_control", "loss_end_of_subtask", "loss_subtask"} <= set(logs)
    for name, path in logs.items():
        rows = list(csv.reader(path.open()))
        assert [float(row[0]) for row in rows] == list(range(20 if "keyword" in name or "language" in name else 2))
        assert all(float(row[1]) >= 0 for row in rows)
    accuracies = [name for name in logs if "accuracy" in name]
    assert len(accuracies) == 3  # of three stages, not mixed


def test_evaluate_writes_its_json(trained, some, tmp_path):
    cwd, _ = trained
    save_episodes(some, tmp_path / "mine.jsonl")
    done = start("evaluate.py", f"checkpoint={cwd}/runs/brief", "episodes=mine.jsonl", "out=mine.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"mine.jsonl", "mine.json"}
    result = json.loads((tmp_path / "mine.json").read_text())
    assert set(result) == {"summary", "details", "episodes"}
    assert [record["id"] for record in result["episodes"]] == [episode.id for episode in some]
    for record, episode in zip(result["episodes"], some, strict=True):
        assert (record["town"], record["keyword"]) == (episode.town, episode.keyword)
        assert record["instruction"] == episode.instruction
        for flag in ("success", "strict_success", "collision", "off_road", "wrong_lane", "finished", "stuck"):
            assert type(record[flag]) is bool, flag
    assert result["summary"]["episodes"] == 4
    assert {town: values["episodes"] for town, values in result["summary"]["towns"].items()} == {"town2": 2, "town1": 2}
    assert "| town1 |" in done.stdout


def test_evaluate_prints_without_writing(trained, some, tmp_path, call):
    cwd, _ = trained
    save_episodes(some[:1], tmp_path / "mine.jsonl")
    printed, error = call("evaluate.py", f"checkpoint={cwd}/runs/brief", "episodes=mine.jsonl", cwd=tmp_path)
    assert error in (None, 0)
    assert "| town2 |" in printed
    assert [path.name for path in tmp_path.iterdir()] == ["mine.jsonl"]


def test_evaluate_plans_episodes_on_a_map(trained, tmp_path, call, monkeypatch):
    cwd, _ = trained
    planned = iter(builtin_episodes(Town.load(MAP))[:3])
    monkeypatch.setattr("ldrl.envs.builtin_episodes", lambda town, split: list(planned))  # a few do
    printed, error = call("evaluate.py", f"checkpoint={cwd}/runs/brief", f"episodes={MAP}", "out=m.json", cwd=tmp_path)
    assert error in (None, 0)
    assert "theta.xodr" in printed
    records = json.loads((tmp_path / "m.json").read_text())["episodes"]
    assert [record["id"] for record in records] == [f"theta.xodr-left-{k}" for k in range(3)]


def test_evaluate_says_that_a_map_has_no_junction(trained, tmp_path, call, monkeypatch):
    cwd, _ = trained
    monkeypatch.setattr("ldrl.envs.builtin_episodes", lambda town, split: [])
    _, error = call("evaluate.py", f"checkpoint={cwd}/runs/brief", f"episodes={MAP}", cwd=tmp_path)
    assert re.fullmatch(r"error: no keyword can be realised in .*theta\.xodr; give a map with junctions", error)


@pytest.mark.parametrize(
    ("arguments", "asked"),
    [
        (["episodes=builtin"], [("town1", "heldout", {}), ("town2", "heldout", {})]),
        (["episodes=builtin", "appearance=rain"], [("town1", "heldout", {}), ("town2", "heldout", {})]),
        (["episodes=noise"], [("town1", "noise", {}), ("town2", "noise", {})]),
        (["episodes=misleading", "routes_per_keyword=3"], [(k, "misleading", {"most_routes": 3}) for k in TOWNS]),
        (["episodes=unseen", "unseen_towns=2"], [(k, "heldout", {"most_routes": 2}) for k in ("town1", "town2")]),
    ],
)
def test_evaluate_plans_what_is_asked_for(trained, episodes, towns, tmp_path, call, monkeypatch, arguments, asked):
    cwd, _ = trained
    found = []

    def plan(town, split="misleading", **settings):
        found.append((town.name, split, settings))
        return [min(episodes[town.name], key=lambda e: len(e.path))]

    monkeypatch.setattr("ldrl.envs.builtin_episodes", lambda town, split="heldout", **most: plan(town, split, **most))
    monkeypatch.setattr("ldrl.envs.misleading_episodes", plan)
    load = Town.load
    monkeypatch.setattr(Town, "load", lambda name: load(name.replace("random-0", "town1").replace("random-1", "town2")))
    printed, error = call("evaluate.py", f"checkpoint={cwd}/runs/brief", *arguments, cwd=tmp_path)
    assert error in (None, 0)
    assert found == asked
    assert "100%" in printed
    # The paper reports nothing of other sentences, towns and weathers.
    in_paper = {"episodes=builtin", "episodes=misleading"} & {*arguments} and "appearance=rain" not in arguments
    assert ("0.9" in printed.split("| paper |")[1]) == bool(in_paper)


def test_odd_instructions_are_no_errors(trained, some, tmp_path, call):
    cwd, _ = trained
    odd = ["word " * 5000, "zzyzzyx qwrtz", "🚗 ⬅️", "Links abbiegen!"]
    said = [type(e)(**{**vars(e), "instruction": text}) for e, text in zip(some, odd, strict=True)]
    save_episodes(said, tmp_path / "odd.jsonl")
    where = (f"checkpoint={cwd}/runs/brief", "episodes=odd.jsonl", "out=odd.json")
    _, error = call("evaluate.py", *where, cwd=tmp_path)
    assert error in (None, 0)
    records = json.loads((tmp_path / "odd.json").read_text())["episodes"]
    assert [record["instruction"] for record in records] == odd


def broken(episode, **changes):
    record = json.loads(json.dumps(vars(episode)))
    record.update(changes)
    return json.dumps({key: value for key, value in record.items() if value is not ...})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (lambda e: broken(e)[:-5], "mine.jsonl, line 2: not JSON"),
        (lambda e: broken(e, start=...), "mine.jsonl, line 2: start missing"),
        (lambda e: broken(e, town="atlantis"), "mine.jsonl, line 2: unknown town 'atlantis'; use one of town1, town2"),
        (lambda e: broken(e, keyword="third left"), "mine.jsonl, line 2: unknown keyword 'third left'"),
        (lambda e: broken(e, path=[]), "mine.jsonl, line 2: path is []; give at least one point"),
        (lambda e: broken(e, instruction=""), "mine.jsonl, line 2: the instruction '' has no word"),
        (lambda e: broken(e, start=[9999, 9999, 0]), "from the nearest lane of 'town2'"),
    ],
)
def test_broken_episode_files(trained, some, tmp_path, call, line, message):
    cwd, _ = trained
    (tmp_path / "mine.jsonl").write_text(f"{broken(some[0])}\n{line(some[0])}\n")
    where = (f"checkpoint={cwd}/runs/brief", "episodes=mine.jsonl", "out=mine.json")
    _, error = call("evaluate.py", *where, cwd=tmp_path)
    assert error.startswith("error: ")
    assert message in error
    assert "\n" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["mine.jsonl"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["checkpoint=atlantis"], "no checkpoint 'atlantis'; give a folder with"),
        (["checkpoint=7"], "no checkpoint '7'"),
        (["checkpoint=cut"], "agent.safetensors is no complete safetensors file"),
        (["checkpoint=foreign"], "agent.json is no agent config"),
        (
            ["episodes=none.jsonl"],
            "there is no episode file 'none.jsonl'; give a JSON-lines file, a map (.xodr) or one of builtin, ",
        ),
        (["episodes=7"], "there is no episode file '7'"),
        (["episodes=none.xodr"], "there is no map 'none.xodr'; give an OpenDRIVE file"),
        (["out=no/such/folder.json"], "cannot write 'no/such/folder.json'"),
        (["out=cut"], "cannot write 'cut'"),
        (["num_cars=0"], "num_cars is 0; give a whole number of at least 1"),
        (["episodes=unseen", "unseen_towns=0"], "unseen_towns is 0; give a whole number of at least 1"),
        (["routes_per_keyword=0"], "routes_per_keyword is 0; give a whole number of at least 1"),
        (["num_cars=some"], "num_cars is 'some'; give a whole number of at least 1"),
        (["appearance=hail"], "weather 'hail' is unknown; use one of clear"),
        (["device=moon"], "moon"),
    ],
)
def test_bad_arguments_of_evaluate(trained, some, tmp_path, call, arguments, message):
    cwd, _ = trained
    checkpoint = cwd / "runs" / "brief"
    for name in ("cut", "foreign"):
        (tmp_path / name).mkdir()
        for file in ("agent.json", "agent.safetensors"):
            (tmp_path / name / file).write_bytes((checkpoint / file).read_bytes())
    (tmp_path / "cut" / "agent.safetensors").write_bytes((checkpoint / "agent.safetensors").read_bytes()[:999])
    (tmp_path / "foreign" / "agent.json").write_text('{"model_type": "llama"}')
    save_episodes(some, tmp_path / "mine.jsonl")
    given = {"checkpoint": checkpoint, "episodes": "mine.jsonl", "out": "mine.json"}
    given |= dict(argument.split("=") for argument in arguments)
    _, error = call("evaluate.py", *(f"{key}={value}" for key, value in given.items()), cwd=tmp_path)
    assert str(error).startswith("error: ")
    assert message in error
    assert "\n" not in error
    assert {path.name for path in tmp_path.iterdir()} == {"cut", "foreign", "mine.jsonl"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["towns=[atlantis]"], "'atlantis'"),
        (["towns=town1"], "towns is 'town1'; give a list, such as towns=[town1]"),
        (["towns=[]"], "towns is empty; give at least one, such as towns=[town1]"),
        (["test_towns=[]"], "test_towns is empty"),
        (["sentences=100"], "sentences is 100; give at least a batch of them, 256"),
        (["stages=[low_level,high_level]"], "nothing has learned to read: add language, or set start_from.high_level"),
        (["model=hihh", "misleading=0.25"], "'hihh'"),
        (["stages=language"], "stages is 'language'; give a list, such as stages=[language]"),
        (["stages=[language,drawing]"], "stages has 'drawing'; use some of low_level, language, high_level"),
        (["model=single", "stages=[low_level]"], "nothing of model single is trained, and nothing is taken"),
        (["stages=[]"], "nothing of model hih is trained, and nothing is taken from a trained agent"),
        (["misleading=25"], "misleading is 25; give a share from 0 to 1"),
        (["misleading=some"], "misleading is some; give a share from 0 to 1"),
        (["misleading=true"], "misleading is True; give a share from 0 to 1"),
        (["learning_rate=fast"], "learning_rate is 'fast'; give a number above 0"),
        (["max_grad_norm=0"], "max_grad_norm is 0; give a number above 0"),
        (["towns=[maps/a.xodr,other/a.xodr]"], "give each town once, and maps whose files have other names"),
        (["name=../elsewhere"], "name is '../elsewhere'; give that of a folder below runs/"),
        (["appearance=episode"], "appearance is 'episode', but training has frames, not episodes"),
        (["start_from.low_level=7"], "no checkpoint '7'"),
        (["high_level_steps=0"], "high_level_steps is 0; give a whole number of at least 1"),
        (["sentences=many"], "sentences is 'many'; give a whole number of at least 1"),
        (["episodes_per_keyword=-1"], "episodes_per_keyword is -1; give a whole number of at least 0"),
        (["seed=0.5"], "seed is 0.5; give a whole number of at least 0"),
        (["start_from.demonstrations=atlantis"], "no demonstrations in 'atlantis/demonstrations/town1'; give a folder"),
        (["model=single", "misleading=0.25"], "misleading is 0.25 for model single, which cannot stop; set it to 0"),
        (["start_from.low_level=atlantis"], "no checkpoint 'atlantis'"),
        (["modality=rgb", "appearance=hail"], "weather 'hail' is unknown; use one of clear"),
        (["test_towns=[town2,atlantis]"], "'atlantis'"),
        (["modality=ps", "segmenter=."], "segmenter"),
        (["size.features=0"], "features is 0; give a whole number above 0"),
        (["size.conv_channels=8"], "conv_channels is 8; give three sizes"),
        (["size.image_rows=10"], "rows is 10"),
        (["device=moon"], "moon"),
    ],
)
def test_bad_arguments_of_training(tmp_path, call, arguments, message):
    _, error = call("bc_hierarchical.py", *BRIEF, *TINY, *arguments, cwd=tmp_path)
    assert str(error).startswith("error: ")
    assert message in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("demonstration_frames=1000", "1000 frames do not divide among 128 cars"),
        ("batch_slices=6", "use a multiple of"),
        ("demonstration_frames=1280", "no drive in 1280 frames of town1 realises left, right"),
    ],
)
def test_settings_that_do_not_fit_show_before_the_sentences_are_learned(tmp_path, call, argument, message):
    printed, error = call("bc_hierarchical.py", *BRIEF, *TINY, argument, cwd=tmp_path)
    assert str(error).startswith("error: ")
    assert message in error
    assert "language:" not in printed


@pytest.mark.parametrize(
    ("arguments", "trained_on", "beside"),
    [
        (["model=single"], "language: 20 batches; drives: 2 batches; 38,400", "single, gs"),
        (["modality=rgb", "misleading=0.25", "stages=[high_level]"], "high_level: 2 batches; 38,400", "hih, rgb"),
    ],
)
def test_other_models_images_and_instructions(trained, tmp_path, call, arguments, trained_on, beside):
    cwd, _ = trained
    start_from = f"start_from.high_level={cwd}/runs/brief"
    some = ("name=other", "drives_steps=2", "batch_drives=2", "drive_length=20", "test_towns=[town2]")
    printed, error = call("bc_hierarchical.py", *BRIEF, *TINY, *some, *arguments, start_from, cwd=tmp_path)
    assert error is None
    assert "Taken from trained agents: " in printed
    report = " ".join((tmp_path / "runs" / "other" / "report.md").read_text().replace("\\", "").split())
    assert f"| Trained | {trained_on}" in report
    assert f"| Started from | high_level from {cwd}/runs/brief |" in report
    assert f"| {beside} |" in report
    assert load_agent(tmp_path / "runs" / "other")


def test_misleading_and_looks_reach_the_training(trained, tmp_path, call, monkeypatch):
    made = {BoundarySampler: [], DashCamera: []}
    for kind, calls in made.items():

        def spy(self, *arguments, _init=kind.__init__, _calls=calls, **settings):
            _calls.append(settings)
            _init(self, *arguments, **settings)

        monkeypatch.setattr(kind, "__init__", spy)
    start_from = f"start_from.high_level={trained[0]}/runs/brief"
    some = ("name=safe", "test_towns=[town2]", "modality=rgb", "appearance=7", "misleading=0.25", "stages=[high_level]")
    _, error = call("bc_hierarchical.py", *BRIEF, *TINY, *some, start_from, cwd=tmp_path)
    assert error is None
    assert [settings["misleading"] for settings in made[BoundarySampler]] == [0.25]
    looks = [settings["appearance"] for settings in made[DashCamera]]
    assert looks[:2] == [7, 7]  # the check of the settings, and the images of the training
    assert set(looks[2:]) == {"clear"}
    report = json.loads((tmp_path / "runs" / "safe" / "report.json").read_text())
    assert all("-misleading-" in record["id"] for record in report["episodes"])
    assert report["details"]["Episodes"] == "misleading"
    assert report["details"]["Settings"] == "appearance=7, segmenter=road-segmenter, misleading=0.25"


def test_a_batch_whose_gradient_overflows_is_left_out_and_told(tmp_path, capsys):
    class Overflows(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(()))
            self.factors = iter([1.0, math.inf, 1.0])

        def forward(self, batch):
            return TensorDict({"loss_it": self.weight * next(self.factors)})

    class Buffer:
        def sample(self):
            return TensorDict({}, [4])

    kind = runpy.run_path(str(RECIPES / "bc_hierarchical.py"), run_name="recipe")["Training"]
    training, loss = kind.__new__(kind), Overflows()
    settings = {"it_steps": 3, "learning_rate": 0.1, "max_grad_norm": 1.0, "device": "cpu"}
    training.cfg, training.history, training.batches = OmegaConf.create(settings), {}, {}
    training.logger = CSVLogger("log", str(tmp_path))
    training.fit("it", [loss], [Buffer()], 4)
    assert loss.weight.isfinite()
    assert loss.weight < 1
    assert training.batches == {"it": 2}
    assert training.history["gradient_norm_it"] == [1.0, math.inf, 1.0]
    assert "1 of 3 batches were left out, their gradient was not finite." in capsys.readouterr().out


def test_unwritable_run_folder(tmp_path, call):
    (tmp_path / "runs").write_text("a file where the folder should be")
    _, error = call("bc_hierarchical.py", *BRIEF, *TINY, cwd=tmp_path)
    assert str(error).startswith("error: ")
    assert "runs" in error
    assert (tmp_path / "runs").read_text() == "a file where the folder should be"


def test_unknown_presets_are_named(tmp_path, call):
    printed, error = call("bc_hierarchical.py", "preset=atlantis", cwd=tmp_path)
    assert error == 1
    assert "preset/atlantis" in printed
    assert re.search(r"default\s+full\s+smoke", printed)
    assert not list(tmp_path.iterdir())


def leaves(values):
    return (key for key in values if key not in ("defaults", "hydra"))


@pytest.mark.parametrize("recipe", ["bc_hierarchical", "evaluate", "reproduce_paper", "train_segmenter"])
def test_every_config_key_is_read(recipe):
    files = [RECIPES / "config" / f"{recipe}.yaml"]
    if recipe == "bc_hierarchical":
        files += (RECIPES / "config" / "preset").glob("*.yaml")
    source = (RECIPES / f"{recipe}.py").read_text()
    for title in re.findall(r'fit\("(\w+)"', source):  # read as cfg[f"{title}_steps"]
        source += f" cfg.{title}_steps"
    keys = {key for file in files for key in leaves(yaml.safe_load(file.read_text()))}
    assert keys
    unread = {key for key in keys if not re.search(rf"\bcfg\.{key}\b", source)}
    assert not unread


def test_presets_and_sizes_have_the_same_keys():
    for group in ("preset", "size"):
        files = sorted((RECIPES / "config" / group).glob("*.yaml"))
        assert len(files) > 1
        config = {file.stem: yaml.safe_load(file.read_text()) for file in files}
        found = {name: set(leaves(values)) - {"name"} for name, values in config.items()}
        for name, keys in found.items():
            on_top_of = [found[other] for other in config[name].get("defaults", [])]
            assert keys.union(*on_top_of) == found["smoke" if group == "preset" else "small"]


def test_sizes_are_agent_configs():
    models = {file.stem: yaml.safe_load(file.read_text()) for file in (RECIPES / "config" / "size").glob("*.yaml")}
    assert AgentConfig(**models["small"]) == AgentConfig()
    assert AgentConfig(**models["paper"]) == AgentConfig.paper()
