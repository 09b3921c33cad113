"""Networks as TensorDictModules, and the agent that they make."""

from ldrl.modules.agent import AgentConfig, HierarchicalAgent
from ldrl.modules.attention import GatedAttention, LuongAttention
from ldrl.modules.checkpoint import PRETRAINED, load_agent, resolve_checkpoint, save_agent
from ldrl.modules.controller import SwitchingController
from ldrl.modules.encoders import ImageEncoder, InstructionEncoder
from ldrl.modules.high_level import NO_SUBTASK, HighLevelPolicy, HistoryDecoder
from ldrl.modules.low_level import BranchedGRU, LowLevelPolicy

__all__ = [
    "NO_SUBTASK",
    "PRETRAINED",
    "AgentConfig",
    "BranchedGRU",
    "GatedAttention",
    "HierarchicalAgent",
    "HighLevelPolicy",
    "HistoryDecoder",
    "ImageEncoder",
    "InstructionEncoder",
    "LowLevelPolicy",
    "LuongAttention",
    "SwitchingController",
    "load_agent",
    "resolve_checkpoint",
    "save_agent",
]
