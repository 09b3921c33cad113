"""How many steps a second env, dash camera and agent make together, and what each part of it takes.

python benchmarks/agent_in_the_loop.py [--cars 64] [--steps 200] [--device cpu] [--model small]
"""

from __future__ import annotations

import argparse
import platform
import time

import torch
from torchrl.envs import step_mdp

from ldrl.envs import make_env
from ldrl.modules import AgentConfig, HierarchicalAgent

WARM_UP = 20


def steps_per_second(policy, cars: int, steps: int, device: str) -> float:
    """Step a roaming batch; with a policy that reads no image none is drawn."""
    env = make_env("town1", cars, policy=policy, device=device)
    tensordict = env.reset()
    for step in range(WARM_UP + steps):
        if step == WARM_UP:
            synchronize(device)
            began = time.perf_counter()
        tensordict = step_mdp(env.step(policy(tensordict)))
    synchronize(device)
    return cars * steps / (time.perf_counter() - began)


def synchronize(device: str) -> None:
    """Wait for the device."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


class Steady(torch.nn.Module):
    """Holds the speed and goes straight on.

    Args:
        image: whether to ask for the image.
    """

    def __init__(self, image: bool) -> None:
        super().__init__()
        self.in_keys = [("observation", "image")] if image else []

    def forward(self, tensordict):
        """Write the action."""
        action = torch.tensor([0.3, 0.0], device=tensordict.device)
        return tensordict.set("action", action.expand(*tensordict.batch_size, 2))


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cars", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--model", choices=("small", "paper"), default="small")
    args = parser.parse_args()
    agent = HierarchicalAgent(AgentConfig.paper() if args.model == "paper" else AgentConfig()).eval().to(args.device)
    rows = {"env": Steady(image=False), "env + camera": Steady(image=True), f"env + camera + {args.model} agent": agent}
    print(f"{args.cars} cars, {args.device}, {torch.get_num_threads()} threads, {platform.machine()}\n")
    print("| what | env-steps/s |\n| --- | ---: |")
    with torch.no_grad():
        for name, policy in rows.items():
            print(f"| {name} | {steps_per_second(policy, args.cars, args.steps, args.device):,.0f} |", flush=True)


if __name__ == "__main__":
    main()
