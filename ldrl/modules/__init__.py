"""Networks as TensorDictModules, and the agents that they make."""

from ldrl.modules.agent import Agent
from ldrl.modules.attention import Concatenation, GatedAttention, LastWord, LuongAttention
from ldrl.modules.checkpoint import PRETRAINED, copy_trained, load_agent, resolve_checkpoint, save_agent
from ldrl.modules.config import MODELS, AgentConfig, Parts
from ldrl.modules.controller import SwitchingController
from ldrl.modules.encoders import ImageEncoder, InstructionEncoder
from ldrl.modules.hierarchical import HierarchicalAgent, make_agent
from ldrl.modules.high_level import NO_SUBTASK, Decoder, HighLevelPolicy, InstructedPolicy
from ldrl.modules.low_level import BranchedGRU, LowLevelPolicy, SubtaskGate
from ldrl.modules.sequences import unroll
from ldrl.modules.single import SingleAgent, SinglePolicy

__all__ = [
    "MODELS",
    "NO_SUBTASK",
    "PRETRAINED",
    "Agent",
    "AgentConfig",
    "BranchedGRU",
    "Concatenation",
    "Decoder",
    "GatedAttention",
    "HierarchicalAgent",
    "HighLevelPolicy",
    "ImageEncoder",
    "InstructedPolicy",
    "InstructionEncoder",
    "LastWord",
    "LowLevelPolicy",
    "LuongAttention",
    "Parts",
    "SingleAgent",
    "SinglePolicy",
    "SubtaskGate",
    "SwitchingController",
    "copy_trained",
    "load_agent",
    "make_agent",
    "resolve_checkpoint",
    "save_agent",
    "unroll",
]
