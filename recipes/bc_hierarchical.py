"""Behaviour cloning of the whole hierarchy: collect, train three networks, evaluate both towns, report.

    python recipes/bc_hierarchical.py                   # a laptop's preset
    python recipes/bc_hierarchical.py preset=smoke      # everything once, to see it run
    python recipes/bc_hierarchical.py model=paper       # the paper's sizes
    python recipes/bc_hierarchical.py seed=1 name=seed1

Results go to runs/<name>/: the checkpoint, report.md, report.json, pictures of the tracks, loss curves and a CSV log.
"""

from __future__ import annotations

import platform
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers import Sampler, Storage
from torchrl.envs import Compose, DeviceCastTransform
from torchrl.objectives import LossModule
from torchrl.record import CSVLogger
from tqdm import tqdm

from ldrl.collectors import BoundarySampler, DisturbedView, SnippetSampler, collect_demonstrations, evaluate
from ldrl.collectors.plots import plot_losses, plot_tracks
from ldrl.collectors.report import replacing, table, to_markdown, write_json
from ldrl.envs import DashCamera, Episode, builtin_episodes
from ldrl.modules import AgentConfig, HierarchicalAgent, save_agent
from ldrl.objectives import ControlLoss, EndOfSubtaskLoss, SubtaskLoss
from ldrl.towns import Town

History = dict[str, list[float]]


def fit(
    cfg: DictConfig,
    title: str,
    losses: Sequence[LossModule],
    buffer: TensorDictReplayBuffer,
    rows: int,
    logger: CSVLogger,
) -> History:
    """Minimise losses together over ``cfg.<title>_steps`` batches of ``rows`` sequences."""
    parameters = [parameter for loss in losses for parameter in loss.parameters()]
    steps = cfg[f"{title}_steps"]
    optimizer = torch.optim.Adam(parameters)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, cfg.learning_rate, total_steps=steps, pct_start=0.1)
    history: History = defaultdict(list)

    def update(batch: TensorDictBase) -> dict[str, float]:
        outputs = [loss(batch) for loss in losses]
        sum(value for output in outputs for name, value in output.items() if name.startswith("loss_")).backward()
        torch.nn.utils.clip_grad_norm_(parameters, cfg.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        return {name: float(value) for output in outputs for name, value in output.items()}

    bar = tqdm(range(steps), desc=title.replace("_", " "), unit="batch")
    for step in bar:
        measured = update(buffer.sample().reshape(rows, -1))
        bar.set_postfix({name.removeprefix("loss_"): f"{value:.3f}" for name, value in measured.items()})
        for name, value in measured.items():
            history[name].append(value)
            logger.log_scalar(name, value, step)
    return history


def view(cfg: DictConfig, storage: Storage, sampler: Sampler, batch_size: int, disturbed: DisturbedView, town: Town):
    """A buffer over the demonstrations that draws their images, seen from disturbed poses, when sampled."""
    camera = DashCamera(town, modality=cfg.modality, appearance=cfg.appearance, seed=cfg.seed)
    return TensorDictReplayBuffer(
        storage=storage,
        sampler=sampler,
        batch_size=batch_size,
        transform=Compose(disturbed, DeviceCastTransform(cfg.device), camera.to(cfg.device)),
    )


def train(cfg: DictConfig, agent: HierarchicalAgent, folder: Path) -> History:
    """Collect demonstrations and train the three networks."""
    town = Town.load(cfg.town)
    shutil.rmtree(folder / "log", ignore_errors=True)  # of a run of the same name: the logger would append to it
    logger = CSVLogger("log", str(folder))
    demonstrations = collect_demonstrations(
        town, cfg.demonstration_frames, path=folder / "demonstrations", seed=cfg.seed
    )
    slices = view(
        cfg,
        demonstrations.storage,
        SnippetSampler(demonstrations, cfg.slice_length, seed=cfg.seed),
        cfg.batch_slices * cfg.slice_length,
        DisturbedView(town, cfg.slice_length, seed=cfg.seed),
        town,
    )
    losses = [ControlLoss(agent.control), EndOfSubtaskLoss(agent.end_of_subtask)]
    history = fit(cfg, "low_level", losses, slices, cfg.batch_slices, logger)
    sampler = BoundarySampler(demonstrations, town, seed=cfg.seed)
    decisions = view(
        cfg,
        demonstrations.storage,
        sampler,
        cfg.batch_sequences * sampler.decisions,
        DisturbedView(town, 1, lateral=0.3, yaw=0.1, seed=cfg.seed),
        town,
    )
    return history | fit(cfg, "high_level", [SubtaskLoss(agent.high_level)], decisions, cfg.batch_sequences, logger)


def choose_episodes(cfg: DictConfig, towns: dict[str, Town]) -> list[Episode]:
    """The built-in episodes of both towns, all or the first few of each keyword."""
    episodes, seen = [], defaultdict(int)
    for town in towns.values():
        for episode in builtin_episodes(town):
            seen[town.name, episode.keyword] += 1
            if cfg.episodes_per_keyword is None or seen[town.name, episode.keyword] <= cfg.episodes_per_keyword:
                episodes.append(episode)
    return episodes


@hydra.main(config_path="config", config_name="bc_hierarchical", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run all stages."""
    folder = Path("runs") / str(cfg.name)
    torch.manual_seed(cfg.seed)
    try:
        towns = {town.name: town for town in map(Town.load, (cfg.town, cfg.test_town))}
        agent = HierarchicalAgent(AgentConfig(modality=cfg.modality, **OmegaConf.to_container(cfg.model))).to(cfg.device)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(cfg, folder / "config.yaml")
    except (OSError, ValueError, RuntimeError, AssertionError) as error:  # the last two: no such device
        sys.exit(f"error: {error}")
    began = time.perf_counter()

    history = train(cfg, agent, folder)
    save_agent(agent, folder)
    plot_losses({name: losses for name, losses in history.items() if name.startswith("loss_")}, folder / "losses.png")
    trained = time.perf_counter()

    episodes = choose_episodes(cfg, towns)
    with tqdm(total=len(episodes), desc="evaluation", unit="episode") as bar:
        outcomes = evaluate(agent, episodes, towns, device=cfg.device, progress=bar.update)
    write_json(outcomes, folder / "report.json")
    for town in towns.values():
        plot_tracks(outcomes, town, folder / f"tracks_{town.name}.png")
    details = {
        "Preset": f"{cfg.demonstration_frames:,} frames of demonstrations, {cfg.low_level_steps:,} low-level and "
        f"{cfg.high_level_steps:,} high-level batches",
        "Seed": str(cfg.seed),
        "Training": f"{trained - began:.0f} s",
        "Evaluation": f"{time.perf_counter() - trained:.0f} s",
        "Hardware": f"{platform.machine()}, {torch.get_num_threads()} threads, device {cfg.device}",
        "Versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }
    report = to_markdown(outcomes, title=folder.name, details=details)
    with replacing(folder / "report.md") as file:
        file.write_text(report, encoding="utf-8")
    print(f"\n{table(outcomes)}\nEverything is in {folder}/; start with report.md and tracks_{next(iter(towns))}.png.")


if __name__ == "__main__":
    main()
