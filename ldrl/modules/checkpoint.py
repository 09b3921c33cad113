"""Checkpoints: a folder with the weights (safetensors) and the config (JSON).

A config may instead name, from its folder, another checkpoint as its ``weights`` and only what differs from its config:
the agent on ps is that on gs.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from ldrl.modules.agent import Agent
from ldrl.modules.config import AgentConfig
from ldrl.modules.hierarchical import HierarchicalAgent, make_agent

__all__ = ["PRETRAINED", "copy_trained", "load_agent", "resolve_checkpoint", "save_agent"]

WEIGHTS = "agent.safetensors"
CONFIG = "agent.json"
SHIPPED = Path(__file__).parent / "weights"
PRETRAINED = tuple(sorted(folder.name for folder in SHIPPED.glob("*") if (folder / CONFIG).is_file()))
"""Names of the checkpoints that ship with the package."""


def save_agent(agent: Agent, folder: str | Path, dtype: torch.dtype | None = None) -> None:
    """Write a checkpoint; an old one is replaced only once the new one is complete.

    Args:
        agent: what to save.
        folder: where; made if missing.
        dtype: what weights are rounded to in the files, such as ``torch.float16`` for half their size; None leaves them
            as they are. Once loaded they are float32 again.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.detach().cpu().contiguous() for name, value in agent.state_dict().items()}
    if dtype is not None:
        weights = {name: value.to(dtype) if value.is_floating_point() else value for name, value in weights.items()}
    save_file(weights, folder / f"{WEIGHTS}.part")
    (folder / f"{CONFIG}.part").write_text(json.dumps(asdict(agent.config), indent=2) + "\n", encoding="utf-8")
    for name in (WEIGHTS, CONFIG):
        os.replace(folder / f"{name}.part", folder / name)


def resolve_checkpoint(name: str | Path) -> Path:
    """The folder of a checkpoint.

    Args:
        name: a folder, or the name of a checkpoint that ships with the package.

    Raises:
        ValueError: there is neither; the message lists the names.
    """
    for folder in (Path(str(name)), SHIPPED / str(name)):
        if (folder / CONFIG).is_file() and (_lender(folder) / WEIGHTS).is_file():
            return folder
    known = ", ".join(PRETRAINED) or "none"
    raise ValueError(
        f"no checkpoint {str(name)!r}; give a folder with {WEIGHTS} and {CONFIG}, or one of the shipped ones: {known}"
    )


def load_agent(name: str | Path, device: torch.device | str = "cpu") -> Agent:
    """Load a checkpoint, ready to drive (in evaluation mode).

    Args:
        name: a folder, or the name of a checkpoint that ships with the package.
        device: where the agent is to run.

    Raises:
        ValueError: there is no such checkpoint, or its files are broken or another model's.
    """
    folder = resolve_checkpoint(name)
    agent, file = _untrained(folder), _lender(folder) / WEIGHTS
    try:
        weights = load_file(file)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{file} is no complete safetensors file ({error}); copy or train it anew") from None
    expected = {key: tuple(value.shape) for key, value in agent.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in weights.items()}
    if expected != found:
        odd = sorted(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key))
        raise ValueError(
            f"{file} does not fit {folder / CONFIG}: {odd[0]} is {found.get(odd[0], 'missing')}, expected "
            f"{expected.get(odd[0], 'absent')}; use the weights and the config of one training with "
            "this version of ldrl"
        )
    agent.load_state_dict(weights)
    return agent.eval().to(device)


def copy_trained(agent: Agent, low_level: str | Path | None = None, high_level: str | Path | None = None) -> list[str]:
    """Copy from trained agents the largest parts that fit: same name, same class, same tensors.

    Args:
        agent: what is to be trained; a single policy is made of the parts of a high-level policy.
        low_level: the checkpoint that the networks of the low level are taken from.
        high_level: that of the high level.

    Returns:
        The names of the parts.

    Raises:
        ValueError: as :func:`load_agent` does.
    """
    own = "high_level" if isinstance(agent, HierarchicalAgent) else "policy"
    copied: list[str] = []
    for checkpoint, networks in ((low_level, ("control", "end_of_subtask")), (high_level, (own,))):
        if checkpoint is None:
            continue
        trained = {name.replace("high_level", own): module for name, module in load_agent(checkpoint).named_modules()}
        for name, module in agent.named_modules():
            if name.split(".")[0] not in networks or any(name.startswith(f"{part}.") for part in copied):
                continue
            theirs, shapes = trained.get(name), {key: value.shape for key, value in module.state_dict().items()}
            if not shapes or theirs is None or type(theirs) is not type(module):
                continue
            if shapes == {key: value.shape for key, value in theirs.state_dict().items()}:
                module.load_state_dict(theirs.state_dict())
                copied.append(name)
    return copied


def _lender(folder: Path) -> Path:
    """The folder that has a checkpoint's weights: its own, or the one that its config names."""
    try:
        return folder / json.loads((folder / CONFIG).read_text(encoding="utf-8")).get("weights", "")
    except (ValueError, TypeError, AttributeError):  # no agent config, which is told when it is read
        return folder


def _untrained(folder: Path) -> Agent:
    """The agent of a checkpoint's config, with random weights."""
    try:
        settings: dict[str, Any] = {}
        for config in (_lender(folder) / CONFIG, folder / CONFIG):
            settings |= json.loads(config.read_text(encoding="utf-8"))
        settings.pop("weights", None)
        return make_agent(AgentConfig(**settings))
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        names = ", ".join(field.name for field in fields(AgentConfig))
        raise ValueError(f"{folder / CONFIG} is no agent config ({error}); it is a JSON object with {names}") from None
