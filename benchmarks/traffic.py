"""Ten minutes of traffic by itself: whether cars touch, whether they get stuck, and how fast that is.

python benchmarks/traffic.py [--cars 20] [--worlds 16] [--steps 6000] [--towns town1 town2]
"""

from __future__ import annotations

import argparse
import time

import torch

from ldrl.envs import vehicle
from ldrl.envs.traffic import Agent, Traffic
from ldrl.towns import Town

STUCK = 600
"""Steps that a car may stand, a minute."""


def drive(town: Town, worlds: int, cars: int, steps: int) -> list[str]:
    """Move the cars of some worlds and look at every step."""
    traffic = Traffic(town, worlds, cars, torch.Generator().manual_seed(0), town.points)
    nowhere = torch.full((worlds, 3), 1e6)
    agent = Agent(nowhere, torch.zeros(worlds), torch.zeros(worlds, 6, dtype=torch.long), torch.zeros(worlds))
    mask = torch.ones(worlds, dtype=torch.bool)
    traffic.reset(mask, nowhere)
    touched, standing, longest = 0, torch.zeros(worlds, cars), 0.0
    speeds, last_minute, began, seconds = [], torch.zeros(worlds, cars), time.perf_counter(), 0.0
    upper = torch.ones(cars, cars, dtype=torch.bool).triu(1)
    for step in range(steps):
        began = time.perf_counter()
        traffic.step(mask, agent)
        seconds += time.perf_counter() - began
        state = traffic.state
        touched += int((vehicle.overlap(state[:, :, None, :3], state[:, None, :, :3]) & upper).any((1, 2)).sum())
        standing = (standing + 1) * (state[..., 3] < 0.1)
        longest = max(longest, float(standing.max()))
        speeds.append(float(state[..., 3].mean()))
        if step >= steps - STUCK:
            last_minute += state[..., 3] * vehicle.TIME_STEP
    return [
        town.name,
        f"{cars}",
        f"{worlds}",
        f"{touched}",
        f"{3.6 * sum(speeds) / steps:.1f}",
        f"{longest / 10:.0f}",
        f"{float(last_minute.mean(-1).min()):.0f}",
        f"{float(last_minute.min()):.0f}",
        f"{worlds * steps / seconds:,.0f}",
    ]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cars", type=int, nargs="+", default=[20])
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--towns", nargs="+", default=["town1", "town2"])
    args = parser.parse_args()
    print(
        "| town | cars | worlds | world-steps with a contact | mean km/h | longest stand, s | "
        "m in the last minute, slowest world | slowest car | world-steps/s |"
    )
    print("| --- |" + " ---: |" * 8)
    with torch.no_grad():
        for name in args.towns:
            for cars in args.cars:
                print(f"| {' | '.join(drive(Town.load(name), args.worlds, cars, args.steps))} |", flush=True)


if __name__ == "__main__":
    main()
