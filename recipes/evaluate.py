"""Evaluate a checkpoint on episodes: print the table, write the JSON.

    python recipes/evaluate.py checkpoint=hierarchical-gs
    python recipes/evaluate.py checkpoint=runs/seed1 episodes=mine.jsonl out=mine.json
    python recipes/evaluate.py checkpoint=hierarchical-gs episodes=maps/village.xodr

`checkpoint` is a folder or the name of a checkpoint that ships with the package; `episodes` is a JSON-lines file,
`builtin` for the planner's episodes in the built-in towns, or an OpenDRIVE map for the planner's episodes there; `out`
is the JSON file to write, none by default.
"""

from __future__ import annotations

import sys

import hydra
from omegaconf import DictConfig
from tqdm import tqdm

from ldrl.collectors import evaluate
from ldrl.collectors.report import check_writable, keyword_table, table, write_json
from ldrl.envs import builtin_episodes, load_episodes
from ldrl.modules import load_agent
from ldrl.towns import LAYOUTS, Town


@hydra.main(config_path="config", config_name="evaluate", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Check everything, then drive."""
    try:
        if cfg.num_cars < 1:
            raise ValueError(f"num_cars is {cfg.num_cars}; give at least 1")
        agent = load_agent(str(cfg.checkpoint), cfg.device)
        source = str(cfg.episodes)
        loaded = [Town.load(name) for name in ([source] if source.endswith(".xodr") else LAYOUTS)]
        towns = {town.name: town for town in loaded}
        if source == "builtin" or source.endswith(".xodr"):
            episodes = [episode for town in loaded for episode in builtin_episodes(town)]
        else:
            episodes = load_episodes(source, towns)
        if not episodes:
            raise ValueError(f"no keyword can be realised in {source}; give a map with junctions")
        if cfg.out is not None:
            check_writable(str(cfg.out))
    except (OSError, ValueError, RuntimeError, AssertionError) as error:  # the last two: no such device
        sys.exit(f"error: {error}")
    with tqdm(total=len(episodes), desc="evaluation", unit="episode") as bar:
        outcomes = evaluate(agent, episodes, towns, num_cars=cfg.num_cars, device=cfg.device, progress=bar.update)
    print(f"{table(outcomes)}\n\n{keyword_table(outcomes)}")
    if cfg.out is not None:
        write_json(outcomes, str(cfg.out))
        print(f"Every episode's outcome is in {cfg.out}.")


if __name__ == "__main__":
    main()
