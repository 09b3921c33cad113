"""Evaluate a checkpoint on episodes: print the table, write the JSON.

    python recipes/evaluate.py checkpoint=hierarchical-gs
    python recipes/evaluate.py checkpoint=runs/seed1 episodes=mine.jsonl out=mine.json
    python recipes/evaluate.py checkpoint=hierarchical-gs episodes=maps/village.xodr
    python recipes/evaluate.py checkpoint=hierarchical-gs episodes=rambling
    python recipes/evaluate.py checkpoint=hierarchical-rgb episodes=unseen appearance=rain

`checkpoint` is a folder or the name of a checkpoint that ships with the package; `out` is the JSON file to write, none
by default. `episodes` is a JSON-lines file; an OpenDRIVE map for the planner's episodes there; or, in the built-in
towns, `builtin` for the planner's episodes, `paraphrase`, `ambiguity`, `noise` or `rambling` for the same in such
sentences, `misleading` for directions that the map does not allow; or `unseen` for the planner's in random towns.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import get_args

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from ldrl.collectors import evaluate
from ldrl.collectors.paper import paper_success
from ldrl.collectors.report import check_whole_numbers, check_writable, keyword_table, table, write_json
from ldrl.envs import Episode, builtin_episodes, load_episodes, make_camera, misleading_episodes
from ldrl.language import Family
from ldrl.modules import load_agent
from ldrl.towns import LAYOUTS, Town

FAMILIES = get_args(Family)
SETS = ("builtin", *FAMILIES, "misleading", "unseen")
TOWNS_AT_ONCE = 10
"""How many of the unseen towns are driven in side by side."""


def choose_episodes(cfg: DictConfig) -> Iterator[tuple[dict[str, Town], list[Episode]]]:
    """Towns and their episodes; some unseen towns at a time, so that many need no memory together."""
    source = str(cfg.episodes)
    most = {} if cfg.routes_per_keyword is None else {"most_routes": cfg.routes_per_keyword}
    if source == "unseen":
        for first in range(0, cfg.unseen_towns, TOWNS_AT_ONCE):
            numbers = range(first, min(first + TOWNS_AT_ONCE, cfg.unseen_towns))
            towns = {town.name: town for town in (Town.load(f"random-{k}") for k in numbers)}
            few = {"most_routes": 2} | most
            yield towns, [episode for town in towns.values() for episode in builtin_episodes(town, **few)]
    elif source in SETS or source.endswith(".xodr"):
        towns = {town.name: town for town in map(Town.load, LAYOUTS if source in SETS else [source])}
        if source == "misleading":
            planned = [misleading_episodes(town, **most) for town in towns.values()]
        else:
            split = source if source in FAMILIES else "heldout"
            planned = [builtin_episodes(town, split, **most) for town in towns.values()]
        yield towns, list(chain.from_iterable(planned))
    elif Path(source).is_file():
        towns = {name: Town.load(name) for name in LAYOUTS}
        yield towns, load_episodes(source, towns)
    else:
        raise ValueError(
            f"there is no episode file {source!r}; give a JSON-lines file, a map (.xodr) or one of {', '.join(SETS)}"
        )


@hydra.main(config_path="config", config_name="evaluate", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Check everything, then drive."""
    try:
        check_whole_numbers(cfg, {"num_cars": 1, "unseen_towns": 1})
        if cfg.routes_per_keyword is not None:
            check_whole_numbers(cfg, {"routes_per_keyword": 1})
        agent = load_agent(str(cfg.checkpoint), cfg.device)
        chosen = choose_episodes(cfg)
        first = next(chosen)
        if not first[1]:
            raise ValueError(f"no keyword can be realised in {cfg.episodes}; give a map with junctions")
        make_camera(next(iter(first[0].values())), agent.modality, appearance=cfg.appearance, segmenter=cfg.segmenter)
        if cfg.out is not None:
            check_writable(str(cfg.out))
    except (ImportError, OSError, ValueError, RuntimeError, AssertionError) as error:  # the last two: no such device
        sys.exit(f"error: {error}")
    settings = {"appearance": cfg.appearance, "segmenter": cfg.segmenter, "device": cfg.device}
    outcomes = []
    with tqdm(desc="evaluation", unit="episode", total=0) as bar:
        for towns, episodes in chain([first], chosen):
            bar.total += len(episodes)
            outcomes += evaluate(agent, episodes, towns, num_cars=cfg.num_cars, progress=bar.update, **settings)
    in_paper = cfg.episodes in ("builtin", "misleading") and cfg.appearance == "clear"
    paper = paper_success(agent.config, misleading=cfg.episodes == "misleading") if in_paper else {}
    print(f"{table(outcomes, paper)}\n\n{keyword_table(outcomes)}")
    if cfg.out is not None:
        details = {"checkpoint": cfg.checkpoint, "episodes": cfg.episodes} | settings
        write_json(outcomes, str(cfg.out), {name: str(value) for name, value in details.items()})
        print(f"Every episode's outcome is in {cfg.out}.")


if __name__ == "__main__":
    main()
