"""What every agent has: a config, a memory in the TensorDict, and a step."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Composite, TensorSpec
from torchrl.envs import TensorDictPrimer
from torchrl.modules import set_recurrent_mode

from ldrl import keys
from ldrl.modules.config import AgentConfig

__all__ = ["Agent"]


class Agent(TensorDictModuleBase):
    """Language and image in, throttle and steer out.

    The agent's memory lies in the TensorDict under ``"agent"``: :meth:`make_tensordict_primer` gives the transform
    that an env needs to hold it. A subclass gives ``_memory``, ``_step`` and ``out_keys``.

    Args:
        config: which model, and its sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.config = config
        self.modality = config.modality

    @classmethod
    def from_pretrained(cls, name: str, device: torch.device | str = "cpu") -> Self:
        """A trained agent; see :func:`~ldrl.modules.load_agent`.

        Args:
            name: a checkpoint that ships with the package, such as ``"hierarchical-gs"``, or a folder.
            device: where the agent is to run.

        Raises:
            ValueError: the checkpoint is broken, or an agent of another class.
        """
        from ldrl.modules.checkpoint import load_agent

        agent = load_agent(name, device)
        if not isinstance(agent, cls):
            raise ValueError(f"{name!r} is a {type(agent).__name__}, no {cls.__name__}; use load_agent")
        return agent

    @property
    @abstractmethod
    def _memory(self) -> dict[tuple[str, ...], TensorSpec]:
        """Key and spec of everything that the agent remembers, for one car."""

    @abstractmethod
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What a batch ``[B]`` of cars with ``in_keys`` does and remembers; may change its argument."""

    @property
    def in_keys(self) -> list:
        """The image, the instruction and the memory."""
        return [keys.IMAGE, keys.INSTRUCTION_TOKENS, *self._memory]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an env's TensorDict the agent's memory, zero at each reset."""
        memory = Composite()
        for key, spec in self._memory.items():
            memory[key] = spec
        return TensorDictPrimer(memory, expand_specs=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One step.

        Args:
            tensordict: any batch size, with ``in_keys``.

        Returns:
            The same, with ``out_keys``: the action, what the agent says about it, and the memory for the next step
            under ``("next", "agent")``.

        Raises:
            KeyError: an input or the memory is missing: the env lacks a transform, such as
                :meth:`make_tensordict_primer`.
        """
        in_keys = self.in_keys
        missing = [key for key in in_keys if key not in tensordict.keys(True, True)]
        if missing:
            raise KeyError(
                f"{missing[0]} is missing; give the env a DashCamera, an Instruction and agent.make_tensordict_primer()"
            )
        if tensordict.batch_dims != 1:
            flat = tensordict.select(*in_keys).reshape(-1)
            return tensordict.update(self(flat).reshape(tensordict.shape))
        with set_recurrent_mode(False):  # a step of each, also where a loss lets its networks run over time
            return tensordict.update(self._step(tensordict.select(*in_keys)))
