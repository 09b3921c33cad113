"""The hierarchical agent: the paper's figure as one policy; and the agent of any config."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from ldrl import keys
from ldrl.language import MAX_TOKENS
from ldrl.modules.agent import Agent
from ldrl.modules.config import AgentConfig
from ldrl.modules.controller import VOTES, SwitchingController
from ldrl.modules.encoders import ImageEncoder
from ldrl.modules.high_level import HighLevelPolicy
from ldrl.modules.low_level import LowLevelPolicy, SubtaskGate
from ldrl.modules.single import SingleAgent
from ldrl.subtasks import SubTask

__all__ = ["HierarchicalAgent", "make_agent"]


class HierarchicalAgent(Agent):
    """Language and image in, throttle and steer out: high-level policy, low-level policies, switching controller.

    All parts are attributes and may be replaced by modules with the same keys and sizes of state. A call is one step of
    a batch of cars; only rows that switch run the high-level policy.

    Args:
        config: with a hierarchical model; None for the paper's full one.

    Examples:
        >>> from ldrl.envs import make_env
        >>> agent = HierarchicalAgent()
        >>> env = make_env("town1", num_cars=2, policy=agent)
        >>> env.rollout(3, agent)["action"].shape
        torch.Size([2, 3, 2])
    """

    def __init__(self, config: AgentConfig | None = None) -> None:
        super().__init__(AgentConfig() if config is None else config)
        if not self.config.parts.hierarchical:
            raise ValueError(f"model is {self.config.model!r}, which has no hierarchy; use make_agent")
        # Made first, so that a seed gives the same low level whatever the reader's size.
        self.control = self._low_level("control", keys.ACTION, 2)
        self.end_of_subtask = self._low_level("end", keys.END_LOGIT, 1)
        self.high_level = HighLevelPolicy(self.config)
        self.controller = SwitchingController()
        self.out_keys = [
            keys.ACTION, keys.AGENT_SUBTASK, keys.AGENT_FINISH, keys.SWITCH, *(("next", *key) for key in self._memory)
        ]  # fmt: skip

    def _low_level(self, name: str, out_key: NestedKey, outputs: int) -> LowLevelPolicy:
        config = self.config
        return LowLevelPolicy(
            name,
            out_key,
            outputs,
            encoder=ImageEncoder(config.image_channels, config.conv_channels, config.image_rows),
            features=config.features,
            hidden=config.low_level_hidden,
            gate=None if config.parts.branched else SubtaskGate(config.subtask_embedding, config.conv_channels[-1]),
        )

    @property
    def _memory(self) -> dict[tuple[str, ...], TensorSpec]:
        return {
            keys.AGENT_SUBTASK: Categorical(len(SubTask), ()),
            keys.VOTES: Bounded(0, 1, (VOTES,), dtype=torch.bool),
            keys.AGE: Unbounded((), dtype=torch.int64),
            keys.PLANNED_TOKENS: Unbounded((MAX_TOKENS,), dtype=torch.int64),
            keys.HIGH_LEVEL_STATE: Unbounded((self.high_level.hidden,)),
            self.control.state_key: Unbounded((self.control.hidden,)),
            self.end_of_subtask.state_key: Unbounded((self.end_of_subtask.hidden,)),
        }

    def decide(self, tensordict: TensorDictBase) -> None:
        """Ask the high-level policy in the rows that switch."""
        switch = tensordict[keys.SWITCH]
        tensordict["next", *keys.HIGH_LEVEL_STATE] = tensordict[keys.HIGH_LEVEL_STATE].clone()
        tensordict[keys.AGENT_SUBTASK] = tensordict[keys.AGENT_SUBTASK].clone()
        rows = switch.nonzero().squeeze(-1)
        if not len(rows):
            return
        asked = tensordict.select(*self.high_level.in_keys)[rows]
        self.high_level(asked)
        tensordict[keys.AGENT_SUBTASK][rows] = asked[keys.SUBTASK_LOGITS].argmax(-1)
        tensordict["next", *keys.HIGH_LEVEL_STATE][rows] = asked["next", *keys.HIGH_LEVEL_STATE]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.controller(tensordict)
        self.decide(tensordict)
        keep = ~tensordict[keys.SWITCH]
        for policy in (self.control, self.end_of_subtask):
            tensordict[policy.state_key] = tensordict[policy.state_key] * keep.unsqueeze(-1)
            policy(tensordict)
        subtask = tensordict[keys.AGENT_SUBTASK]
        finish = subtask == SubTask.FINISH
        throttle, steer = tensordict[keys.ACTION].unbind(-1)
        vote = tensordict[keys.END_LOGIT] > 0
        after = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        after[keys.ACTION] = torch.stack((throttle.clamp(0, 1) * ~finish, steer.clamp(-1, 1)), -1)
        after[keys.AGENT_SUBTASK] = subtask
        after[keys.AGENT_FINISH] = finish
        after[keys.SWITCH] = tensordict[keys.SWITCH]
        after["next"] = tensordict["next"]
        after["next", *keys.AGENT_SUBTASK] = subtask
        after["next", *keys.VOTES] = torch.cat((tensordict[keys.VOTES][..., 1:] & keep.unsqueeze(-1), vote), -1)
        after["next", *keys.AGE] = tensordict[keys.AGE] * keep + 1
        after["next", *keys.PLANNED_TOKENS] = tensordict[keys.PLANNED_TOKENS]
        return after


def make_agent(config: AgentConfig) -> Agent:
    """The untrained agent of a config.

    Args:
        config: its model says which class.

    Examples:
        >>> type(make_agent(AgentConfig(model="single-history"))).__name__
        'SingleAgent'
    """
    return HierarchicalAgent(config) if config.parts.hierarchical else SingleAgent(config)
