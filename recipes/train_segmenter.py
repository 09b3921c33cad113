"""Train the road segmenter on random towns in random looks, and measure it on Town 1 and Town 2, which it never saw.

    python recipes/train_segmenter.py
    python recipes/train_segmenter.py network.depth_multiplier=0.5 name=wide
    python recipes/train_segmenter.py steps=2 towns=1 frames=8 name=smoke    # everything once, to see it run

Results go to runs/<name>/: the weights, which RoadSegmenter("runs/<name>") loads, report.md, report.json and
views.png. It needs transformers.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from itertools import product
from pathlib import Path
from typing import NamedTuple

import hydra
import torch
from matplotlib.image import imsave
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate
from tqdm import tqdm

from ldrl.collectors.report import check_whole_numbers, replacing
from ldrl.collectors.results_page import segmenter_table
from ldrl.envs import DashCamera, RoadSegmenter
from ldrl.envs.appearance import WEATHERS
from ldrl.envs.camera import shift
from ldrl.envs.image_format import PREPROCESSING, ImageFormat
from ldrl.towns import Town

BESIDE, TURNED = 0.8, 0.2
"""Standard deviations of the views from a lane's centre (m) and direction (rad), cut at three of them."""
CARS, NEAREST, FARTHEST = 4, 6.0, 40.0
"""Other cars, and how far from the camera they are, m."""
EVALUATED = ("town1", "town2")
LOOKS = (*WEATHERS, "sample", "sample, cars")
"""The town's own materials in each weather, drawn materials and weather, and these with cars in every view."""


class View(NamedTuple):
    """What is seen from one pose each.

    Attributes:
        images: ``[N, 3, 88, 200]`` uint8.
        road: ``[N, 1, 88, 200]`` bool.
    """

    images: Tensor
    road: Tensor


class Views:
    """Draws what is seen of a town from poses beside its lanes and in its junctions.

    Args:
        town: what there is to see.
        appearance: of all views, see :class:`~ldrl.envs.DashCamera`.
        crowded: share of the views with other cars.
        seed: of poses, cars and looks.
        device: where to draw.
    """

    def __init__(self, town: Town, appearance: str, crowded: float, seed: int, device: str) -> None:
        self.town, self.crowded, self.device = town, crowded, device
        seen = town.on(device)
        self.rgb = DashCamera(seen, modality="rgb", appearance=appearance, seed=seed).to(device)
        self.gs = DashCamera(seen).to(device)
        self._generator = torch.Generator().manual_seed(seed)

    def draw(self, count: int) -> View:
        """Draw ``count`` views."""
        pose = self._lane_poses(torch.randint(len(self.town.points), (count,), generator=self._generator))
        beside, turned = torch.randn(2, count, generator=self._generator).clamp(-3, 3)
        pose = shift(pose, BESIDE * beside, TURNED * turned)
        pose, cars = pose.to(self.device), self._cars(pose).to(self.device)
        return View(self.rgb.draw(pose, cars), self.gs.draw(pose, cars) > 0)

    def _cars(self, pose: Tensor) -> Tensor:
        """Cars on lanes near each pose, ``[N, 4, 4]``, or NaN where there are none."""
        distance = torch.cdist(pose[:, :2], self.town.points.cpu())
        near = ((distance > NEAREST) & (distance < FARTHEST)).float()
        cars = self._lane_poses(torch.multinomial(near, CARS, generator=self._generator))
        none = torch.rand(len(pose), generator=self._generator) >= self.crowded
        return nn.functional.pad(cars, (0, 1)).masked_fill(none.view(-1, 1, 1), torch.nan)

    def _lane_poses(self, point: Tensor) -> Tensor:
        return torch.cat((self.town.points.cpu()[point], self.town.headings.cpu()[point].unsqueeze(-1)), -1)


def fit(cfg: DictConfig, network: nn.Module, image_format: ImageFormat, views: list[Views]) -> None:
    """Minimise the cross entropy of the logits, scaled up to the image, over ``cfg.steps`` batches."""
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, cfg.learning_rate, total_steps=cfg.steps, pct_start=0.15)
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.momentum = 0.05  # the configured 0.997 is TensorFlow's: it would keep the last batch's statistics only
    network.train().to(memory_format=torch.channels_last)

    def update(view: View) -> float:
        road = view.road[:, :, image_format.first_row :].float()
        logits = network(image_format.pixels(view.images)).logits
        # The softmax over two classes depends on the difference of their logits only.
        margin = interpolate(logits[:, 1:] - logits[:, :1], road.shape[-2:], mode="bilinear")
        loss = binary_cross_entropy_with_logits(margin, road)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), cfg.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        return loss.item()

    bar = tqdm(range(cfg.steps), desc="segmenter", unit="batch")
    for step in bar:
        bar.set_postfix(loss=f"{update(views[step % len(views)].draw(cfg.batch)):.3f}")


def measure(cfg: DictConfig, segmenter: RoadSegmenter, towns: list[Town]) -> tuple[list[dict], list[View]]:
    """Intersection over union of the road in each town and look, and the views."""
    rows, seen = [], []
    for town, look in product(towns, LOOKS):
        appearance, _, cars = look.partition(", ")
        view = Views(town, appearance, float(bool(cars)), cfg.seed + 1, cfg.device).draw(cfg.frames)
        found = segmenter.segment(view.images) > 0
        both, either = ((mask.flatten(1).sum(1)) for mask in (found & view.road, found | view.road))
        each = both / either.clamp(min=1)
        rows.append(
            {
                "town": town.name,
                "look": look,
                "iou": round(float(both.sum() / either.sum()), 4),
                "worst_view": round(float(each[either > 0].min()), 4),
            }
        )
        seen.append(view)
    return rows, seen


def plot_views(segmenter: RoadSegmenter, views: list[View], path: Path) -> None:
    """A line for each town and look, two views in each: what is seen, the road, the road found, where they differ."""
    lines = []
    for line, view in enumerate(views):
        some = [k % len(view.images) for k in (2 * line, 2 * line + 1)]  # the poses are the same in each look
        images, road = view.images[some], view.road[some]
        found = segmenter.segment(images) > 0
        wrong = torch.cat((road & ~found, found & ~road, torch.zeros_like(road)), 1)  # red is missed, green made up
        parts = [images, *(mask.expand_as(images).to(torch.uint8) * 255 for mask in (road, found, wrong))]
        lines.append(torch.stack(parts, 1).permute(3, 0, 1, 4, 2).flatten(1, 3))
    imsave(path, torch.cat(lines).cpu().numpy())


def check(cfg: DictConfig) -> None:
    """Raise a ValueError for settings of which nothing can be made."""
    check_whole_numbers(cfg, {"seed": 0, "first_town": 0, "towns": 1, "steps": 1, "batch": 1, "frames": 1})
    if cfg.first_row not in range(88):
        raise ValueError(f"first_row is {cfg.first_row!r}; give a row of the image, 0 to 87")
    rows_and_columns = OmegaConf.is_list(cfg.input_size) and len(cfg.input_size) == 2
    if not rows_and_columns or not all(type(value) is int and value > 0 for value in cfg.input_size):
        raise ValueError(f"input_size is {cfg.input_size}; give rows and columns, such as [44,100]")


@hydra.main(config_path="config", config_name="train_segmenter", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run all stages."""
    folder = Path("runs") / str(cfg.name)
    try:
        check(cfg)
        torch.manual_seed(cfg.seed)
        image_format = ImageFormat(size=tuple(cfg.input_size), first_row=cfg.first_row)
        from transformers import MobileNetV2Config, MobileNetV2ForSemanticSegmentation

        settings = OmegaConf.to_container(cfg.network) | {"id2label": {0: "background", 1: "road"}}
        network = MobileNetV2ForSemanticSegmentation(MobileNetV2Config(**settings)).to(cfg.device)
        folder.mkdir(parents=True, exist_ok=True)
    except (ImportError, OSError, ValueError, RuntimeError, AssertionError) as error:  # the last two: no such device
        sys.exit(f"error: {error}")
    began = time.perf_counter()
    towns = (Town.load(f"random-{cfg.first_town + k}") for k in range(cfg.towns))
    views = [
        Views(town, "sample", 0.5, cfg.seed + k, cfg.device)
        for k, town in enumerate(tqdm(towns, "towns", cfg.towns, unit="town"))
    ]
    fit(cfg, network, image_format, views)
    network.save_pretrained(folder)
    image_format.write(folder / PREPROCESSING)
    trained = time.perf_counter()

    segmenter = RoadSegmenter(folder).to(cfg.device)
    rows, seen = measure(cfg, segmenter, [Town.load(name) for name in EVALUATED])
    plot_views(segmenter, seen, folder / "views.png")
    details = {
        "training": f"{cfg.steps:,} batches of {cfg.batch} views, {cfg.towns} random towns from {cfg.first_town} on, "
        f"{trained - began:.0f} s",
        "evaluation": f"{cfg.frames} views of each town and look",
        "hardware": f"{platform.machine()}, {torch.get_num_threads()} threads, device {cfg.device}",
        "versions": f"Python {platform.python_version()}, torch {torch.__version__}",
    }
    report = {"details": details, "config": OmegaConf.to_container(cfg), "rows": rows}
    listed = "\n".join(f"- {name}: {told}" for name, told in details.items())
    with replacing(folder / "report.json") as file:
        file.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    with replacing(folder / "report.md") as file:
        file.write_text(f"# {folder.name}\n\n{segmenter_table(rows)}\n\n{listed}\n", encoding="utf-8")
    print(f"\n{segmenter_table(rows)}\nEverything is in {folder}/; start with report.md and views.png.")


if __name__ == "__main__":
    main()
