"""Environments and their transforms."""

from ldrl.envs.camera import DashCamera
from ldrl.envs.episodes import Episode, builtin_episodes, load_episodes, save_episodes
from ldrl.envs.factory import Modality, make_camera, make_env, make_highway_env
from ldrl.envs.highway import HighwayTownEnv
from ldrl.envs.instruction import Instruction
from ldrl.envs.labels import SubtaskLabels
from ldrl.envs.misleading import misleading_episodes, misleading_routes
from ldrl.envs.segmenter import RoadSegmenter
from ldrl.envs.town import TownEnv

__all__ = [
    "DashCamera",
    "Episode",
    "HighwayTownEnv",
    "Instruction",
    "Modality",
    "RoadSegmenter",
    "SubtaskLabels",
    "TownEnv",
    "builtin_episodes",
    "load_episodes",
    "make_camera",
    "make_env",
    "make_highway_env",
    "misleading_episodes",
    "misleading_routes",
    "save_episodes",
]
