"""Behaviour cloning of an agent: collect, train its networks, evaluate both towns, report.

    python recipes/bc_hierarchical.py                          # a laptop's preset: the full model on gs
    python recipes/bc_hierarchical.py preset=smoke             # everything once, to see it run
    python recipes/bc_hierarchical.py preset=full              # as docs/results.md and the shipped weights are made
    python recipes/bc_hierarchical.py name=h0 model=h0             # another of the paper's models
    python recipes/bc_hierarchical.py name=rgb modality=rgb        # from colour images
    python recipes/bc_hierarchical.py name=safe misleading=0.25    # trained for what the map does not allow
    python recipes/bc_hierarchical.py name=hi model=hi "stages=[language,high_level]" start_from.low_level=runs/h0

Results go to runs/<name>/: the checkpoint, report.md, report.json, pictures of the tracks, loss curves and a CSV log.
"""

from __future__ import annotations

import math
import platform
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn
from torchrl.data import TensorDictReplayBuffer as Buffer
from torchrl.data.replay_buffers import Sampler
from torchrl.envs import Compose, DeviceCastTransform, Transform
from torchrl.objectives import LossModule
from torchrl.record import CSVLogger
from tqdm import tqdm

from ldrl import keys
from ldrl.collectors import (
    BoundarySampler,
    DisturbedView,
    DriveSampler,
    OncePerFrame,
    SnippetSampler,
    collect_demonstrations,
    collect_sentences,
    evaluate,
    load_demonstrations,
)
from ldrl.collectors.paper import paper_success
from ldrl.collectors.plots import plot_losses, plot_tracks
from ldrl.collectors.report import check_whole_numbers, replacing, table, to_markdown, write_json
from ldrl.envs import Episode, builtin_episodes, make_camera, misleading_episodes
from ldrl.modules import Agent, AgentConfig, HierarchicalAgent, copy_trained, make_agent, save_agent
from ldrl.objectives import ControlLoss, EndOfSubtaskLoss, KeywordLoss, SinglePolicyLoss, SubtaskLoss
from ldrl.towns import Town

STAGES = ("low_level", "language", "high_level")  # the first soon shows whether all settings fit
COUNTS = (
    "demonstration_frames",
    "sentences",
    *(f"{stage}_steps" for stage in (*STAGES, "drives")),
    *(f"batch_{rows}" for rows in ("sentences", "slices", "sequences", "drives")),
    "slice_length",
    "drive_length",
)
"""Settings that are whole numbers above 0."""


class Training:
    """The stages of a training, each a buffer and losses."""

    def __init__(self, cfg: DictConfig, agent: Agent, folder: Path) -> None:
        self.cfg, self.agent, self.folder = cfg, agent, folder
        self.policy = agent.high_level if isinstance(agent, HierarchicalAgent) else agent.policy
        needs_towns = set(cfg.stages) - {"language"}  # reading is learned from sentences alone
        self.towns = [Town.load(name) for name in cfg.towns] if needs_towns else []
        self.given: dict[str, Buffer] = {}
        if cfg.start_from.demonstrations is not None:
            for town in self.towns:
                path = Path(cfg.start_from.demonstrations) / "demonstrations" / town.name
                self.given[town.name] = load_demonstrations(path)
                if (count := len(self.given[town.name])) != cfg.demonstration_frames:
                    raise ValueError(f"demonstration_frames is {cfg.demonstration_frames}; {path} has {count}, set it")
        shutil.rmtree(folder / "log", ignore_errors=True)  # of a run of the same name: the logger would append to it
        self.logger = CSVLogger("log", str(folder))
        self.sequences: list[BoundarySampler] = []
        self.history: dict[str, list[float]] = {}
        self.batches: dict[str, int] = {}

    @cached_property
    def driven(self) -> list[tuple[Town, Buffer, int]]:
        """Towns, the demonstrations there, collected or an earlier run's, and seeds for what is drawn from them."""
        cfg, driven = self.cfg, []
        for k, town in enumerate(tqdm(self.towns, "demonstrations", unit="town")):
            if (demonstrations := self.given.get(town.name)) is None:
                path = self.folder / "demonstrations" / town.name
                demonstrations = collect_demonstrations(town, cfg.demonstration_frames, path=path, seed=cfg.seed)
            driven.append((town, demonstrations, 100 * cfg.seed + k))
        return driven

    def find_sequences(self) -> None:
        """Find what the high level learns from in each town; a single policy learns from whole drives."""
        for town, drives, seed in self.driven:
            if isinstance(self.agent, HierarchicalAgent):
                self.sequences.append(BoundarySampler(drives, town, seed=seed, misleading=self.cfg.misleading))
            else:
                self.sequences.append(DriveSampler(drives, town, self.cfg.drive_length, seed=seed))

    def fit(self, title: str, losses: Sequence[LossModule], buffers: Sequence[Buffer], rows: int) -> None:
        """Minimise losses together over ``cfg.<title>_steps`` batches of ``rows`` sequences, of each buffer in turn."""
        parameters = [p for loss in losses for p in loss.parameters() if p.requires_grad]
        steps = self.cfg[f"{title}_steps"]
        optimizer = torch.optim.Adam(parameters)
        rate = self.cfg.learning_rate
        # A bit more than a tenth, which of ten batches would leave the schedule a phase of no length.
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps, pct_start=0.1001)
        history: dict[str, list[float]] = defaultdict(list)
        bar = tqdm(range(steps), desc=title.replace("_", " "), unit="batch")
        for step in bar:
            batch = buffers[step % len(buffers)].sample().reshape(rows, -1).to(self.cfg.device)
            outputs = [loss(batch) for loss in losses]
            sum(value for output in outputs for name, value in output.items() if name.startswith("loss_")).backward()
            norm = torch.nn.utils.clip_grad_norm_(parameters, self.cfg.max_grad_norm)
            if norm.isfinite():  # through hundreds of frames it may overflow, and one such step would ruin all
                optimizer.step()
            optimizer.zero_grad()
            schedule.step()
            measured = {name: float(value.detach()) for output in outputs for name, value in output.items()}
            bar.set_postfix({name.removeprefix("loss_"): f"{value:.3f}" for name, value in measured.items()})
            measured[f"gradient_norm_{title}"] = float(norm)
            for name, value in measured.items():
                history[name].append(value)
                self.logger.log_scalar(name, value, step)
        self.history |= history
        self.batches[title] = sum(math.isfinite(norm) for norm in history[f"gradient_norm_{title}"])
        if self.batches[title] < steps:
            print(f"{steps - self.batches[title]} of {steps} batches were left out, their gradient was not finite.")

    def views(self, samplers: Sequence[Sampler], frames: int, length: int, **disturbed: float) -> list[Buffer]:
        """For each town a buffer over its demonstrations that draws images, seen from disturbed poses, when sampled."""
        cfg, buffers = self.cfg, []
        for (town, demonstrations, seed), sampler in zip(self.driven, samplers, strict=True):
            transforms: list[Transform] = [DisturbedView(town, length, seed=seed, **disturbed)]
            transforms.append(DeviceCastTransform(cfg.device))
            if isinstance(sampler, SnippetSampler) or keys.IMAGE in self.policy.in_keys:
                looks = {"appearance": cfg.appearance, "segmenter": cfg.segmenter}
                camera = make_camera(town.on(cfg.device), cfg.modality, seed=seed, **looks).to(cfg.device)
                transforms.append(camera if isinstance(sampler, SnippetSampler) else OncePerFrame(camera))
            shown = {"batch_size": frames, "transform": Compose(*transforms)}
            buffers.append(Buffer(storage=demonstrations.storage, sampler=sampler, **shown))
        return buffers

    def language(self) -> None:
        """Learn to read: what sentences mean. The words' encoder then stays as it is."""
        cfg = self.cfg
        sentences = collect_sentences(cfg.sentences, cfg.batch_sentences, seed=cfg.seed)
        self.fit("language", [KeywordLoss(self.policy)], [sentences], cfg.batch_sentences)

    def low_level(self) -> None:
        """Learn to steer and give gas, and to see where a sub-task ends."""
        cfg = self.cfg
        samplers = [SnippetSampler(drives, cfg.slice_length, seed=seed) for _, drives, seed in self.driven]
        slices = self.views(samplers, cfg.batch_slices * cfg.slice_length, cfg.slice_length)
        losses = [ControlLoss(self.agent.control), EndOfSubtaskLoss(self.agent.end_of_subtask)]
        self.fit("low_level", losses, slices, cfg.batch_slices)

    def high_level(self) -> None:
        """Learn to decide; a single policy to act on its own."""
        cfg = self.cfg
        encoder: nn.Module = self.policy.reader[0]
        encoder.requires_grad_(False)
        if isinstance(self.agent, HierarchicalAgent):
            frames = cfg.batch_sequences * self.sequences[0].decisions
            decisions = self.views(self.sequences, frames, 1, lateral=0.3, yaw=0.1)
            self.fit("high_level", [SubtaskLoss(self.policy)], decisions, cfg.batch_sequences)
        else:
            length = cfg.drive_length
            drives = self.views(self.sequences, cfg.batch_drives * length, length)
            self.fit("drives", [SinglePolicyLoss(self.policy)], drives, cfg.batch_drives)
        encoder.requires_grad_(True)


def reads(copied: Sequence[str]) -> bool:
    """Whether the encoder of instructions is in what was copied."""
    encoders = (f"{own}.module.0.module." for own in ("high_level", "policy"))
    return any(encoder.startswith(f"{part}.") for encoder in encoders for part in copied)


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for settings of which nothing can be made."""
    check_names(cfg)
    check_numbers(cfg)


def check_names(cfg: DictConfig) -> None:
    """Raise a ValueError for a wrong name or list of names."""
    for name in ("towns", "test_towns", "stages"):
        if not OmegaConf.is_list(cfg[name]):
            raise ValueError(f"{name} is {cfg[name]!r}; give a list, such as {name}=[{cfg[name]}]")
        if not cfg[name] and name != "stages":
            raise ValueError(f"{name} is empty; give at least one, such as {name}=[town1]")
    for name in ("towns", "test_towns"):
        known = [Path(str(town)).name for town in cfg[name]]
        if len(set(known)) < len(known):  # a map is known by its file's name
            raise ValueError(f"{name} is {cfg[name]}; give each town once, and maps whose files have other names")
    unknown = set(cfg.stages) - set(STAGES)
    if unknown:
        raise ValueError(f"stages has {min(unknown)!r}; use some of {', '.join(STAGES)}")
    if cfg.appearance == "episode":
        raise ValueError("appearance is 'episode', but training has frames, not episodes; use sample, or a weather")
    if str(cfg.name) in ("", ".") or Path(str(cfg.name)).is_absolute() or ".." in Path(str(cfg.name)).parts:
        raise ValueError(f"name is {cfg.name!r}; give that of a folder below runs/, such as hierarchical-gs")


def check_numbers(cfg: DictConfig) -> None:
    """Raise a ValueError for a wrong number."""
    least = dict.fromkeys(COUNTS, 1) | {"seed": 0}
    if cfg.episodes_per_keyword is not None:
        least["episodes_per_keyword"] = 0
    check_whole_numbers(cfg, least)
    if type(cfg.misleading) not in (int, float) or not 0 <= cfg.misleading <= 1:
        raise ValueError(f"misleading is {cfg.misleading}; give a share from 0 to 1")
    for name in ("learning_rate", "max_grad_norm"):
        if type(cfg[name]) not in (int, float) or not cfg[name] > 0:
            raise ValueError(f"{name} is {cfg[name]!r}; give a number above 0")
    if cfg.sentences < cfg.batch_sentences:
        raise ValueError(f"sentences is {cfg.sentences}; give at least a batch of them, {cfg.batch_sentences}")


def choose_episodes(cfg: DictConfig, towns: dict[str, Town]) -> list[Episode]:
    """The built-in episodes of both towns, misleading ones if trained for, all or the first few of each keyword."""
    episodes, seen = [], defaultdict(int)
    for town in towns.values():
        for episode in misleading_episodes(town) if cfg.misleading else builtin_episodes(town):
            seen[town.name, episode.keyword] += 1
            if cfg.episodes_per_keyword is None or seen[town.name, episode.keyword] <= cfg.episodes_per_keyword:
                episodes.append(episode)
    return episodes


def write_report(training: Training, towns: dict[str, Town], copied: Sequence[str], seconds: float) -> None:
    """Evaluate, and write what came of it, from which start, and of how many batches in which time."""
    cfg, agent, folder, batches = training.cfg, training.agent, training.folder, training.batches
    began = time.perf_counter()
    episodes = choose_episodes(cfg, towns)
    with tqdm(total=len(episodes), desc="evaluation", unit="episode") as bar:
        settings = {"segmenter": cfg.segmenter, "device": cfg.device}
        outcomes = evaluate(agent, episodes, towns, progress=bar.update, **settings)
    trained = [f"{stage}: {count:,} batches" for stage, count in batches.items()]
    if set(batches) - {"language"}:
        collected = f", collected for {cfg.start_from.demonstrations}" if training.given else ""
        frames = f"{cfg.demonstration_frames:,} frames of demonstrations in each of {', '.join(cfg.towns)}"
        trained.append(frames + collected)
    levels = {"high_level" if part.startswith(("high_level", "policy")) else "low_level" for part in copied}
    taken = [f"{level} from {cfg.start_from[level]}" for level in sorted(levels, reverse=True)]
    details = {
        "Model": f"{cfg.model}, {cfg.modality}",
        "Episodes": "misleading" if cfg.misleading else "built-in",
        "Settings": f"appearance={cfg.appearance}, segmenter={cfg.segmenter}, misleading={cfg.misleading}",
        "Started from": "; ".join(taken) or "nothing",
        "Trained": "; ".join(trained) or "nothing",
        "Seed": str(cfg.seed),
        "Training": f"{seconds:.0f} s",
        "Evaluation": f"{time.perf_counter() - began:.0f} s",
        "Hardware": f"{platform.machine()}, {torch.get_num_threads()} threads, device {cfg.device}",
        "Versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }
    write_json(outcomes, folder / "report.json", details)
    for old in folder.glob("tracks_*.png"):
        old.unlink()
    for town in towns.values():
        plot_tracks(outcomes, town, folder / f"tracks_{town.name}.png")
    paper = paper_success(agent.config, misleading=bool(cfg.misleading))
    report = to_markdown(outcomes, title=folder.name, paper=paper, details=details)
    with replacing(folder / "report.md") as file:
        file.write_text(report, encoding="utf-8")
    start = f"report.md and tracks_{next(iter(towns))}.png"
    print(f"\n{table(outcomes, paper)}\nEverything is in {folder}/; start with {start}.")


@hydra.main(config_path="config", config_name="bc_hierarchical", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run all stages."""
    folder = Path("runs") / str(cfg.name)
    try:
        check(cfg)
        torch.manual_seed(cfg.seed)
        towns = {town.name: town for town in map(Town.load, cfg.test_towns)}
        config = AgentConfig(model=cfg.model, modality=cfg.modality, **OmegaConf.to_container(cfg.size))
        if cfg.misleading and not config.parts.hierarchical:
            raise ValueError(f"misleading is {cfg.misleading} for model {cfg.model}, which cannot stop; set it to 0")
        agent = make_agent(config).to(cfg.device)
        copied = copy_trained(agent, cfg.start_from.low_level, cfg.start_from.high_level)
        if cfg.start_from.low_level or cfg.start_from.high_level:
            print(f"Taken from trained agents: {', '.join(copied) or 'nothing, as nothing fits'}.")
        if "high_level" in cfg.stages and "language" not in cfg.stages and not reads(copied):
            raise ValueError(
                "stages has high_level, but nothing has learned to read: add language, or set start_from.high_level to "
                "a checkpoint with the same instruction_hidden"
            )
        stages = [name for name in STAGES if name in cfg.stages and (config.parts.hierarchical or name != "low_level")]
        if not stages and not copied:
            raise ValueError(
                f"stages is {cfg.stages}, so nothing of model {cfg.model} is trained, and nothing is taken from a "
                "trained agent: add language and high_level, or set start_from"
            )
        town = next(iter(towns.values()))
        make_camera(town, cfg.modality, appearance=cfg.appearance, segmenter=cfg.segmenter)
        training = Training(cfg, agent, folder)
        folder.mkdir(parents=True, exist_ok=True)
    except (ImportError, OSError, ValueError, RuntimeError, AssertionError) as error:  # the last two: no such device
        sys.exit(f"error: {error}")

    began = time.perf_counter()
    try:
        if "high_level" in stages:  # if there are too few, that shows before anything is learned
            training.find_sequences()
        for stage in stages:
            getattr(training, stage)()
    except ValueError as error:  # too few demonstrations, or a batch that does not divide
        sys.exit(f"error: {error}")
    (folder / "losses.png").unlink(missing_ok=True)
    save_agent(agent, folder)
    OmegaConf.save(cfg, folder / "config.yaml")
    losses = {name: values for name, values in training.history.items() if name.startswith("loss_")}
    if losses:
        plot_losses(losses, folder / "losses.png")
    write_report(training, towns, copied, time.perf_counter() - began)


if __name__ == "__main__":
    main()
