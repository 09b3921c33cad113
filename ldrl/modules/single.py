"""The paper's single policies: one network from instruction and image to the action, without sub-tasks."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Bounded, TensorSpec, Unbounded

from ldrl import keys
from ldrl.language import MAX_TOKENS
from ldrl.modules.agent import Agent
from ldrl.modules.config import AgentConfig
from ldrl.modules.high_level import InstructedPolicy

__all__ = ["SingleAgent", "SinglePolicy"]


class SinglePolicy(InstructedPolicy):
    """The high-level network with the action as its output; the choice before is the previous action.

    Args:
        config: which parts, and their sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__(config, keys.ACTION, 2, keys.PREVIOUS_ACTION, nn.Linear(2, config.subtask_embedding))


class SingleAgent(Agent):
    """Drives by a :class:`SinglePolicy`, asked at every step; it never says that it is done.

    A new instruction starts anew, from a zero state and no previous action.

    Args:
        config: with the model ``"single"`` or ``"single-history"``; None for the former.

    Examples:
        >>> from ldrl.envs import make_env
        >>> agent = SingleAgent()
        >>> make_env("town1", num_cars=2, policy=agent).rollout(3, agent)["action"].shape
        torch.Size([2, 3, 2])
    """

    def __init__(self, config: AgentConfig | None = None) -> None:
        super().__init__(AgentConfig(model="single") if config is None else config)
        if self.config.parts.hierarchical:
            raise ValueError(f"model is {self.config.model!r}; a SingleAgent is 'single' or 'single-history'")
        self.policy = SinglePolicy(self.config)
        self.out_keys = [keys.ACTION, *(("next", *key) for key in self._memory)]

    @property
    def _memory(self) -> dict[tuple[str, ...], TensorSpec]:
        memory: dict[tuple[str, ...], TensorSpec] = {
            keys.PLANNED_TOKENS: Unbounded((MAX_TOKENS,), dtype=torch.int64),
            keys.HIGH_LEVEL_STATE: Unbounded((self.policy.hidden,)),
        }
        if self.config.parts.history:
            memory[keys.PREVIOUS_ACTION] = Bounded(-1, 1, (2,))
        return memory

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        tokens = tensordict[keys.INSTRUCTION_TOKENS]
        heard = (tokens != tensordict[keys.PLANNED_TOKENS]).any(-1, keepdim=True)
        for key in self._memory.keys() - {keys.PLANNED_TOKENS}:
            tensordict[key] = tensordict[key].masked_fill(heard, 0)
        self.policy(tensordict)
        throttle, steer = tensordict[keys.ACTION].unbind(-1)
        after = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        after[keys.ACTION] = torch.stack((throttle.clamp(0, 1), steer.clamp(-1, 1)), -1)
        after["next"] = tensordict["next"]
        after["next", *keys.PLANNED_TOKENS] = tokens
        if self.config.parts.history:
            after["next", *keys.PREVIOUS_ACTION] = after[keys.ACTION]
        return after
