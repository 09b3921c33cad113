"""How fast worlds are, side by side on one machine: highway-env, the batched town env, its cameras, towns and traffic.

python benchmarks/env_speed.py [--device cpu] [--threads 1] [--repeats 5]

A step is 0.1 s of one world. The rows take turns, and a ratio is the median over the turns, so that what else the
machine does touches both of its sides alike. highway-env always runs on the CPU.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import torch
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from torchrl.envs import TransformedEnv, step_mdp

import ldrl  # noqa: F401  (it registers the Gymnasium environments)
from ldrl import keys
from ldrl.envs import DashCamera, TownEnv, vehicle
from ldrl.subtasks import SubTask
from ldrl.towns import Town

BATCHES = (1, 16, 64, 256, 1024)
WORLDS = 64
"""Batch of the rows that compare towns and traffic."""
TRAFFIC = 20
TURN = 0.5
"""How long a row is measured at a time, s."""
MOST_STEPS = 60
"""In a turn: the cars go straight on from their starts, and shall see the town rather than what is around it."""


class Row(NamedTuple):
    """A line of the table."""

    what: str
    worlds: int
    reset: Callable[[], object]
    step: Callable[[], object]
    """One step of all worlds."""
    compared_with: str
    """The row that its ratio is to."""

    @property
    def name(self) -> str:
        """What, and how many at once."""
        return f"{self.what} x{self.worlds}"


class StockTown(AbstractEnv):
    """highway-env as it is: its road, its vehicles, and their kinematics as the observation."""

    @classmethod
    def default_config(cls) -> dict:
        """10 Hz, throttle and steer."""
        changes = {"action": {"type": "ContinuousAction"}, "simulation_frequency": 10, "policy_frequency": 10}
        return super().default_config() | changes | {"town": None, "vehicles_count": 0}

    def _reset(self) -> None:
        town = self.config["town"]
        self.road = Road(town.network, np_random=self.np_random)
        starts = self.np_random.permutation(streets(town))[: 1 + self.config["vehicles_count"]]
        for k, lane in enumerate(starts):
            kind = IDMVehicle if k else self.action_type.vehicle_class
            middle = float(town.lane_length[lane]) / 2
            car = kind.make_on_lane(self.road, town.lane_indices[lane], middle, vehicle.INITIAL_SPEED)
            self.road.vehicles.append(car)
        self.vehicle = self.road.vehicles[0]

    def _reward(self, action: object) -> float:
        return 0.0

    def _is_terminated(self) -> bool:
        return False

    def _is_truncated(self) -> bool:
        return False


def streets(town: Town) -> list[int]:
    """Its lanes outside junctions."""
    return (town.lane_manoeuvre == SubTask.LANEFOLLOW).nonzero().flatten().tolist()


def gymnasium_row(what: str, env: gymnasium.Env, action: list[float], compared_with: str) -> Row:
    """A row of one world."""
    return Row(what, 1, lambda: env.reset(seed=0), lambda: env.step(action), compared_with)


def batched_row(what: str, env: TownEnv | TransformedEnv, compared_with: str) -> Row:
    """A row of as many worlds as the env has."""
    action = torch.tensor([0.3, 0.0], device=env.device).expand(*env.batch_size, 2)
    now = [env.reset()]

    def reset() -> None:
        now[0] = env.reset()

    def step() -> None:
        now[0] = step_mdp(env.step(now[0].set(keys.ACTION, action)))

    return Row(what, env.numel(), reset, step, compared_with)


def with_camera(env: TownEnv, modality: str = "gs") -> TransformedEnv:
    """The env with a dash camera."""
    return TransformedEnv(env, DashCamera(env.town, modality=modality).to(env.device))


def rows(device: str) -> list[Row]:
    """All rows; one that others are compared with comes before them."""
    town1, large = Town.load("town1"), Town.load("random-0-90")
    crowded, gs, stock_road = (
        f"highway-env, {TRAFFIC} IDM cars",
        "TownEnv, gs",
        f"ldrl/Town1-v0, {TRAFFIC} cars, stock road",
    )
    gs_batches = BATCHES if device == "cpu" else (*BATCHES, 4096)
    times = len(streets(large)) / len(streets(town1))

    def cars(count: int, town: Town = town1, **settings: int) -> TownEnv:
        return TownEnv(town, count, device=device, seed=0, max_steps=10**9, **settings)

    def indexed(value: bool) -> gymnasium.Env:
        return gymnasium.make("ldrl/Town1-v0", config={"vehicles_count": TRAFFIC, "indexed": value}).unwrapped

    return [
        gymnasium_row("highway-env", StockTown({"town": town1}), [0.0, 0.0], "highway-env x1"),
        gymnasium_row(crowded, StockTown({"town": town1, "vehicles_count": TRAFFIC}), [0.0, 0.0], f"{crowded} x1"),
        *[batched_row("TownEnv", cars(n), "highway-env x1") for n in BATCHES],
        *[batched_row(gs, with_camera(cars(n)), "highway-env x1") for n in gs_batches],
        *[batched_row("TownEnv, rgb", with_camera(cars(n), "rgb"), "highway-env x1") for n in BATCHES],
        batched_row(
            f"{gs}, town of {times:.0f} times the streets", with_camera(cars(WORLDS, large)), f"{gs} x{WORLDS}"
        ),
        batched_row(f"{gs}, {TRAFFIC} cars each", with_camera(cars(WORLDS, traffic=TRAFFIC)), f"{crowded} x1"),
        batched_row(
            f"{gs}, {TRAFFIC} cars each, {times:.0f} times the streets",
            with_camera(cars(WORLDS, large, traffic=TRAFFIC)),
            f"{gs}, {TRAFFIC} cars each x{WORLDS}",
        ),
        gymnasium_row(stock_road, indexed(False), [0.3, 0.0], f"{crowded} x1"),
        gymnasium_row(f"ldrl/Town1-v0, {TRAFFIC} cars", indexed(True), [0.3, 0.0], f"{stock_road} x1"),
    ]


def steps_per_second(row: Row, device: str) -> float:
    """One turn of a row, from a reset."""
    row.reset()
    row.step()
    synchronize(device)
    steps, began = 0, time.perf_counter()
    while steps < MOST_STEPS and (steps < 3 or time.perf_counter() - began < TURN):
        row.step()
        steps += 1
    synchronize(device)
    return row.worlds * steps / (time.perf_counter() - began)


def synchronize(device: str) -> None:
    """Wait for the device."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    table = rows(args.device)
    speeds: dict[str, list[float]] = {row.name: [] for row in table}
    with torch.no_grad():
        for _ in range(args.repeats):
            for row in table:
                speeds[row.name].append(steps_per_second(row, args.device))
    where = torch.cuda.get_device_name() if args.device.startswith("cuda") else platform.machine()
    print(f"\n{args.device} ({where}), {args.threads} threads, median of {args.repeats} turns\n")
    print("| what | worlds | steps/s | ms for all | times as fast as |\n| --- | ---: | ---: | ---: | ---: |")
    for row in table:
        speed = statistics.median(speeds[row.name])
        ratios = [a / b for a, b in zip(speeds[row.name], speeds[row.compared_with], strict=True)]
        against = "" if row.compared_with == row.name else f"{statistics.median(ratios):,.2f} {row.compared_with}"
        print(f"| {row.what} | {row.worlds} | {speed:,.0f} | {1000 * row.worlds / speed:,.2f} | {against} |")


if __name__ == "__main__":
    main()
