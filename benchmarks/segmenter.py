"""What the predicted segmentation costs: the network by itself, behind the camera, and in the loop.

python benchmarks/segmenter.py [--cars 256] [--repeats 5] [--device cpu] [--threads 1]

The rows take turns, and each tells its median, so that what else the machine does touches all of them alike.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable

import torch
from torchrl.envs import TransformedEnv, step_mdp

from ldrl import keys
from ldrl.envs import DashCamera, RoadSegmenter, TownEnv, make_camera
from ldrl.towns import Town

TURN = 0.5
"""How long a row is measured at a time, s."""
MOST_STEPS = 60
"""In a turn: the cars go straight on from their starts, and shall see the town rather than what is around it."""


def stepping(env: TownEnv | TransformedEnv) -> Callable[[], Callable[[], object]]:
    """A reset, which gives a step of all cars."""
    action = torch.tensor([0.3, 0.0], device=env.device).expand(*env.batch_size, 2)

    def start() -> Callable[[], object]:
        now = [env.reset()]

        def step() -> None:
            now[0] = step_mdp(env.step(now[0].set(keys.ACTION, action)))

        return step

    return start


def rows(cars: int, device: str) -> dict[str, Callable[[], Callable[[], object]]]:
    """What is measured: each starts anew and gives what does ``cars`` frames or steps."""
    town = Town.load("town1")
    camera, segmenter = DashCamera(town, modality="rgb").to(device), RoadSegmenter().to(device)
    places = torch.linspace(0, len(town.points) - 1, cars).long()
    pose = torch.cat((town.points[places], town.headings[places].unsqueeze(-1)), -1).to(device)
    images = camera.draw(pose)

    def env(modality: str | None) -> Callable[[], Callable[[], object]]:
        base = TownEnv(town, cars, device=device, seed=0, max_steps=10**9)
        return stepping(base if modality is None else TransformedEnv(base, make_camera(town, modality).to(device)))

    return {
        "rgb camera, frames": lambda: lambda: camera.draw(pose),
        "segmenter, frames": lambda: lambda: segmenter.segment(images),
        "rgb camera + segmenter, frames": lambda: lambda: segmenter.segment(camera.draw(pose)),
        "TownEnv, env-steps": env(None),
        "TownEnv + gs, env-steps": env("gs"),
        "TownEnv + rgb, env-steps": env("rgb"),
        "TownEnv + ps, env-steps": env("ps"),
    }


def per_second(start: Callable[[], Callable[[], object]], device: str) -> float:
    """One turn of a row, in calls."""
    step = start()
    step()
    synchronize(device)
    calls, began = 0, time.perf_counter()
    while calls < MOST_STEPS and (calls < 3 or time.perf_counter() - began < TURN):
        step()
        calls += 1
    synchronize(device)
    return calls / (time.perf_counter() - began)


def synchronize(device: str) -> None:
    """Wait for the device."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cars", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    table = rows(args.cars, args.device)
    speeds: dict[str, list[float]] = {name: [] for name in table}
    with torch.no_grad():
        for _ in range(args.repeats):
            for name, start in table.items():
                speeds[name].append(per_second(start, args.device))
    where = torch.cuda.get_device_name() if args.device.startswith("cuda") else platform.machine()
    print(f"{args.cars} cars, {args.device} ({where}), {args.threads} threads, median of {args.repeats} turns\n")
    print("| what | a second | ms for all |\n| --- | ---: | ---: |")
    for name, found in speeds.items():
        calls = statistics.median(found)
        print(f"| {name} | {args.cars * calls:,.0f} | {1000 / calls:,.1f} |")


if __name__ == "__main__":
    main()
