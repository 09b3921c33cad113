"""The hierarchical agent: the paper's figure as one policy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import TensorDictPrimer

from ldrl import keys
from ldrl.language import MAX_TOKENS
from ldrl.modules.controller import VOTES, SwitchingController
from ldrl.modules.encoders import ImageEncoder
from ldrl.modules.high_level import HighLevelPolicy
from ldrl.modules.low_level import LowLevelPolicy
from ldrl.subtasks import SubTask

__all__ = ["AgentConfig", "HierarchicalAgent"]

CHANNELS = {"gs": 1, "ps": 1, "rgb": 3}
"""Channels of the image by modality."""


@dataclass(frozen=True)
class AgentConfig:
    """Sizes of the agent; the defaults are small enough for two CPU cores, :meth:`paper` gives the paper's.

    Args:
        modality: what the agent sees: ``"gs"``, ``"ps"`` (one channel) or ``"rgb"``.
        image_rows: how many rows of the image the encoders see, from the bottom up.
        conv_channels: of each image encoder's convolutions.
        features: size of each linear layer behind an image encoder.
        low_level_hidden: size of a low-level GRU; there are four in each of the two networks.
        instruction_hidden: size of the instruction's GRU.
        subtask_embedding: size of the previous sub-task's embedding.
        high_level_hidden: size of the high-level GRU.

    Raises:
        ValueError: a size is no whole number above 0, or the modality is unknown.
    """

    modality: str = "gs"
    image_rows: int = 48
    conv_channels: tuple[int, int, int] = (16, 32, 64)
    features: int = 128
    low_level_hidden: int = 64
    instruction_hidden: int = 64
    subtask_embedding: int = 16
    high_level_hidden: int = 128

    def __post_init__(self) -> None:
        if self.modality not in CHANNELS:
            raise ValueError(f"modality is {self.modality!r}; use one of {', '.join(CHANNELS)}")
        sizes = {name: value for name, value in vars(self).items() if name not in ("modality", "conv_channels")}
        if len(self.conv_channels) != 3:
            raise ValueError(f"conv_channels is {self.conv_channels!r}; give three sizes, one for each convolution")
        for name, value in (*sizes.items(), *(("conv_channels", value) for value in self.conv_channels)):
            if type(value) is not int or value < 1:
                raise ValueError(f"{name} is {value!r}; give a whole number above 0")
        object.__setattr__(self, "conv_channels", tuple(self.conv_channels))

    @classmethod
    def paper(cls) -> AgentConfig:
        """The sizes of the paper's implementation."""
        return cls(
            image_rows=88,
            conv_channels=(256, 64, 64),
            features=256,
            low_level_hidden=256,
            instruction_hidden=32,
            subtask_embedding=64,
            high_level_hidden=256,
        )


class HierarchicalAgent(TensorDictModuleBase):
    """Language and image in, throttle and steer out: high-level policy, low-level policies, switching controller.

    All parts are attributes and may be replaced by modules with the same keys. The agent's memory lies in the
    TensorDict under ``"agent"``: :meth:`make_tensordict_primer` gives the transform that an env needs to hold it.
    A call is one step of a batch of cars; only rows that switch run the high-level policy.

    Args:
        config: sizes.

    Examples:
        >>> from ldrl.envs import make_env
        >>> agent = HierarchicalAgent()
        >>> env = make_env("town1", num_cars=2, policy=agent)
        >>> env.rollout(3, agent)["action"].shape
        torch.Size([2, 3, 2])
    """

    def __init__(self, config: AgentConfig | None = None) -> None:
        super().__init__()
        self.config = config = AgentConfig() if config is None else config

        def encoder() -> ImageEncoder:
            return ImageEncoder(CHANNELS[config.modality], config.conv_channels, config.image_rows)

        self.modality = config.modality
        self.high_level = HighLevelPolicy(
            encoder=encoder(),
            channels=config.conv_channels[-1],
            features=config.features,
            instruction=config.instruction_hidden,
            embedding=config.subtask_embedding,
            hidden=config.high_level_hidden,
        )
        sizes = {"features": config.features, "hidden": config.low_level_hidden}
        self.control = LowLevelPolicy("control", keys.ACTION, 2, encoder=encoder(), **sizes)
        self.end_of_subtask = LowLevelPolicy("end", keys.END_LOGIT, 1, encoder=encoder(), **sizes)
        self.controller = SwitchingController()
        self.in_keys = [keys.IMAGE, keys.INSTRUCTION_TOKENS, *self._memory]
        self.out_keys = [
            keys.ACTION, keys.AGENT_SUBTASK, keys.AGENT_FINISH, keys.SWITCH, *(("next", *key) for key in self._memory)
        ]  # fmt: skip

    @classmethod
    def from_pretrained(cls, name: str, device: torch.device | str = "cpu") -> HierarchicalAgent:
        """A trained agent; see :func:`~ldrl.modules.load_agent`.

        Args:
            name: a checkpoint that ships with the package, such as ``"hierarchical-gs"``, or a folder.
            device: where the agent is to run.
        """
        from ldrl.modules.checkpoint import load_agent

        return load_agent(name, device)

    @property
    def _memory(self) -> dict[tuple[str, ...], TensorSpec]:
        """Key and spec of everything that the agent remembers, for one car."""
        return {
            keys.AGENT_SUBTASK: Categorical(len(SubTask), ()),
            keys.VOTES: Bounded(0, 1, (VOTES,), dtype=torch.bool),
            keys.AGE: Unbounded((), dtype=torch.int64),
            keys.PLANNED_TOKENS: Unbounded((MAX_TOKENS,), dtype=torch.int64),
            keys.HIGH_LEVEL_STATE: Unbounded((self.high_level.hidden,)),
            self.control.state_key: Unbounded((self.control.hidden,)),
            self.end_of_subtask.state_key: Unbounded((self.end_of_subtask.hidden,)),
        }

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an env's TensorDict the agent's memory, zero at each reset."""
        memory = Composite()
        for key, spec in self._memory.items():
            memory[key] = spec
        return TensorDictPrimer(memory, expand_specs=True)

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

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One step.

        Args:
            tensordict: batch size ``[B]`` with ``in_keys``.

        Returns:
            The same, with ``action``, ``("agent", "subtask")``, ``("agent", "finish")`` and the memory for the next
            step under ``("next", "agent")``.

        Raises:
            KeyError: an input or the memory is missing: the env lacks a transform, such as
                :meth:`make_tensordict_primer`.
        """
        missing = [key for key in self.in_keys if key not in tensordict.keys(True, True)]
        if missing:
            raise KeyError(
                f"{missing[0]} is missing; give the env a DashCamera, an Instruction and agent.make_tensordict_primer()"
            )
        if tensordict.batch_dims == 0:
            return tensordict.update(self(tensordict.unsqueeze(0)).squeeze(0))
        memory = tensordict.select(*self.in_keys)
        self.controller(memory)
        self.decide(memory)
        keep = ~memory[keys.SWITCH]
        for policy in (self.control, self.end_of_subtask):
            memory[policy.state_key] = memory[policy.state_key] * keep.unsqueeze(-1)
            policy(memory)
        subtask = memory[keys.AGENT_SUBTASK]
        finish = subtask == SubTask.FINISH
        throttle, steer = memory[keys.ACTION].unbind(-1)
        vote = memory[keys.END_LOGIT] > 0
        after = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        after[keys.ACTION] = torch.stack((throttle.clamp(0, 1) * ~finish, steer.clamp(-1, 1)), -1)
        after[keys.AGENT_SUBTASK] = subtask
        after[keys.AGENT_FINISH] = finish
        after[keys.SWITCH] = memory[keys.SWITCH]
        after["next"] = memory["next"]
        after["next", *keys.AGENT_SUBTASK] = subtask
        after["next", *keys.VOTES] = torch.cat((memory[keys.VOTES][..., 1:] & keep.unsqueeze(-1), vote), -1)
        after["next", *keys.AGE] = memory[keys.AGE] * keep + 1
        after["next", *keys.PLANNED_TOKENS] = memory[keys.PLANNED_TOKENS]
        return tensordict.update(after)
