"""Train and evaluate what the paper's tables need, and write docs/results.md with ours beside the paper's figures.

    python recipes/reproduce_paper.py                                # all of the paper's tables, one seed
    python recipes/reproduce_paper.py "seeds=[0,1,2]"                # three
    python recipes/reproduce_paper.py "tables=[appearance,unseen]"   # looks in training and at night, unseen towns
    python recipes/reproduce_paper.py "tables=[models]"              # only what one table needs
    python recipes/reproduce_paper.py "tables=[]"                    # only write the page again
    python recipes/reproduce_paper.py scale=smoke                    # in little, to see it run

A cell is one training with its evaluation, or one evaluation, done by a command that one may also type; which ones
there are is said in config/reproduce_paper.yaml. Cells go to runs/paper/seed<k>/<cell>/, with what they print in
output.txt. A finished cell is not run again, unless its command, its settings or what it starts from has changed, so a
run that was stopped goes on where it was: to make a cell anew after a change of the code, delete its folder. Figures of
all seeds are kept in docs/results.json, from which the page is written.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ldrl.collectors.report import replacing
from ldrl.collectors.results import MADE, REPORT, Results, read_cells
from ldrl.collectors.results_page import results_page
from ldrl.envs.segmenter import SHIPPED
from ldrl.modules.checkpoint import WEIGHTS

RECIPES = Path(__file__).parent
TRAINING, EVALUATION = "bc_hierarchical.py", "evaluate.py"
OUTPUT = "output.txt"
TAIL = 15
"""Lines of a failed cell's output that are shown."""
KEEPS_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**62)}
"""Tells glibc to keep what is freed: else every batch asks the system for its memory again."""


def digest(content: bytes) -> str:
    """A short hash."""
    return hashlib.sha256(content).hexdigest()[:16]


@dataclass(frozen=True)
class Cell:
    """One training or evaluation.

    Args:
        folder: where its files go.
        recipe: a file of this folder.
        settings: the files below ``config`` that it reads, a later one's values replace an earlier one's.
        arguments: of the recipe.
        needs: folders of the cells that must be finished before, whose checkpoints it takes.
        makes: what it leaves in its folder for others.
    """

    folder: Path
    recipe: str
    settings: tuple[str, ...]
    arguments: tuple[str, ...]
    needs: tuple[Path, ...]
    makes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Seed and cell."""
        return f"{self.folder.parent.name}/{self.folder.name}"

    def origin(self) -> dict[str, Any]:
        """What it is made from: if this has changed, so has the cell."""
        settings = OmegaConf.merge(*(OmegaConf.load(RECIPES / "config" / file) for file in self.settings))
        weights = [folder / WEIGHTS for folder in self.needs]
        if "modality=ps" in self.arguments:
            weights.append(SHIPPED / "road-segmenter" / "model.safetensors")
        return {
            "command": shlex.join(("python", f"recipes/{self.recipe}", *self.arguments)),
            "settings": digest(json.dumps(OmegaConf.to_container(settings)).encode()),
            "weights": [digest(file.read_bytes()) for file in weights],
        }

    def finished(self) -> bool:
        """Whether nothing is to be done; cells that it needs must be finished."""
        if not all((self.folder / file).exists() for file in (MADE, REPORT, *self.makes)):
            return False
        made = json.loads((self.folder / MADE).read_text(encoding="utf-8"))
        changed = [what for what, value in self.origin().items() if made.get(what) != value]
        if changed:
            tqdm.write(f"{self.name}: other {' and '.join(changed)} than before, so it is made again")
        return not changed

    def start(self, threads: int) -> subprocess.Popen:
        """Start it in a process of its own."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / MADE).unlink(missing_ok=True)
        with (self.folder / OUTPUT).open("w", encoding="utf-8") as output:
            return subprocess.Popen(
                [sys.executable, str(RECIPES / self.recipe), *self.arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**KEEPS_MEMORY, **os.environ, "OMP_NUM_THREADS": str(threads)},
            )


def make_cells(cfg: DictConfig) -> list[Cell]:
    """The cells that the tables need, for every seed."""
    table, settings = OmegaConf.to_container(cfg.cells), cfg.scales[cfg.scale]
    for given in table.values():
        if given.get("stages") and "start_from" in given:
            given["start_from"]["demonstrations"] = cfg.collects
    wanted = [cell for title in cfg.tables for cell in cfg.contents[title]]
    for name in wanted:  # grows on the way
        wanted += [needed for needed in needs(table[name]) if needed not in wanted]
    cells = []
    for seed in cfg.seeds:
        folder = Path("runs") / settings.name / f"seed{seed}"
        for name in (name for name in table if name in wanted):
            given = dict(table[name])
            for setting, value in settings.cells.get(name, {}).items():
                given.setdefault(setting, value)
            taken = tuple(folder / needed for needed in needs(given))
            if "checkpoint" in given:
                recipe, read, makes = EVALUATION, ("evaluate.yaml",), ()
                given |= {"checkpoint": taken[0], "out": folder / name / REPORT, **settings.evaluation}
            else:
                recipe = TRAINING
                makes = (WEIGHTS, "demonstrations") if name == cfg.collects else (WEIGHTS,)
                read = ("bc_hierarchical.yaml", "preset/default.yaml", f"preset/{cfg.scale}.yaml", "size/small.yaml")
                own = {"name": (folder / name).relative_to("runs"), "seed": seed, "preset": cfg.scale}
                taken_from = given.pop("start_from", {})
                given = own | given | {f"start_from.{level}": folder / cell for level, cell in taken_from.items()}
            arguments = tuple(argument(*item) for item in given.items())
            cells.append(Cell(folder / name, recipe, read, arguments, taken, makes))
    return cells


def needs(given: Mapping[str, Any]) -> list[str]:
    """The cells that a cell's arguments name."""
    named = [given["checkpoint"]] if "checkpoint" in given else given.get("start_from", {}).values()
    return list(dict.fromkeys(named))


def argument(name: str, value: object) -> str:
    """An argument of a recipe as it is typed."""
    return f"{name}=[{','.join(map(str, value))}]" if isinstance(value, list | tuple) else f"{name}={value}"


class Running(NamedTuple):
    """A cell under way."""

    cell: Cell
    origin: dict[str, Any]  # before it started: files may change under way
    process: subprocess.Popen
    began: float


def run(cells: list[Cell], jobs: int) -> list[Cell]:
    """Make all cells that are not finished, ``jobs`` at a time; after a failure no other is started.

    Returns:
        Those that failed.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = max(1, cores // jobs)
    hardware = f"{processor()}, {cores} cores, {jobs} cells side by side with {threads} threads each"
    waiting, running, done, failed = list(cells), [], set(), []
    bar = tqdm(total=len(cells), desc="cells", unit="cell")
    try:
        while running or (waiting and not failed):
            ready = [cell for cell in waiting if done.issuperset(cell.needs)] if not failed else []
            for cell in ready[: jobs - len(running)]:
                waiting.remove(cell)
                if cell.finished():
                    done.add(cell.folder)
                    bar.update()
                else:
                    running.append(Running(cell, cell.origin(), cell.start(threads), time.time()))
            bar.set_postfix_str(" ".join(each.cell.name for each in running), refresh=False)
            time.sleep(0.2 if running else 0)
            for each in [each for each in running if each.process.poll() is not None]:
                running.remove(each)
                if close(each, hardware):
                    done.add(each.cell.folder)
                    bar.update()
                else:
                    failed.append(each.cell)
    finally:
        bar.close()
        for each in running:
            each.process.terminate()
        for each in running:
            each.process.wait()
    return failed


def processor() -> str:
    """What Linux calls the processor, elsewhere its architecture."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{platform.machine()} ({names[0]})" if names else platform.machine()


def close(ended: Running, hardware: str) -> bool:
    """Write down how a cell was made, if it was."""
    cell, seconds = ended.cell, time.time() - ended.began
    if ended.process.returncode or not (cell.folder / REPORT).is_file():
        tail = (cell.folder / OUTPUT).read_text(encoding="utf-8", errors="replace").splitlines()[-TAIL:]
        tqdm.write("\n".join((f"{cell.name} failed; the end of {cell.folder / OUTPUT}:", *tail)))
        return False
    made = ended.origin | {
        "began": round(ended.began),
        "seconds": round(seconds, 1),
        "hardware": hardware,
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }
    with replacing(cell.folder / MADE) as file:
        file.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    tqdm.write(f"{time.strftime('%H:%M:%S')}  {cell.name}  {seconds:.0f} s")
    return True


def write_page(cfg: DictConfig) -> Path:
    """Add the finished cells to the results and write the page of all."""
    settings = cfg.scales[cfg.scale]
    page = Path(settings.page)
    page.parent.mkdir(parents=True, exist_ok=True)
    results = Results([*Results.load(page.with_suffix(".json")), *read_cells(Path("runs") / settings.name)])
    results.save(page.with_suffix(".json"))
    report = json.loads((SHIPPED / "road-segmenter" / REPORT).read_text(encoding="utf-8"))
    with replacing(page) as file:
        file.write_text(results_page(results, list(cfg.cells), report), encoding="utf-8")
    return page


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for what no run can be made of."""
    for name in ("tables", "seeds"):
        if not OmegaConf.is_list(cfg[name]):
            raise ValueError(f"{name} is {cfg[name]!r}; give a list, such as {name}=[{cfg[name]}]")
    for name, given, known in (("tables", cfg.tables, cfg.contents), ("scale", [cfg.scale], cfg.scales)):
        unknown = [value for value in given if value not in known]
        if unknown:
            raise ValueError(f"{name} has {unknown[0]!r}; use some of {', '.join(known)}")
    for name, given, least in (("jobs", [cfg.jobs], 1), ("seeds", cfg.seeds, 0)):
        if not all(type(value) is int and value >= least for value in given):
            raise ValueError(f"{name} is {cfg[name]}; give whole numbers of at least {least}")
    if len(set(cfg.seeds)) < len(cfg.seeds):  # two cells would write to one folder
        raise ValueError(f"seeds is {cfg.seeds}; give each seed once")


@hydra.main(config_path="config", config_name="reproduce_paper", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run what is missing, then write the page."""
    # So that what is under way ends with this process, not after it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        check(cfg)
        failed = []
        try:
            failed = run(make_cells(cfg), cfg.jobs)
        finally:
            print(f"Results are in {write_page(cfg)}.")
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    if failed:
        sys.exit(f"error: {', '.join(cell.name for cell in failed)} failed; run the same again to go on from here")


if __name__ == "__main__":
    main()
