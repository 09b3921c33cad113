"""Environments and their transforms."""

from ldrl.envs.camera import DashCamera
from ldrl.envs.episodes import Episode, builtin_episodes, load_episodes, save_episodes
from ldrl.envs.factory import make_env
from ldrl.envs.instruction import Instruction
from ldrl.envs.labels import SubtaskLabels
from ldrl.envs.town import TownEnv

__all__ = [
    "DashCamera",
    "Episode",
    "Instruction",
    "SubtaskLabels",
    "TownEnv",
    "builtin_episodes",
    "load_episodes",
    "make_env",
    "save_episodes",
]
