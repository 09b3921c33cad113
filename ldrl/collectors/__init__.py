"""The expert, demonstrations and what is sampled from them, evaluation and reports."""

from ldrl.collectors.demonstrations import SteeringNoise, collect_demonstrations, load_demonstrations
from ldrl.collectors.drives import DriveSampler, OncePerFrame
from ldrl.collectors.evaluation import Outcome, evaluate
from ldrl.collectors.expert import Expert, expert_action
from ldrl.collectors.segments import BoundarySampler, Segment, find_misleading, find_segments
from ldrl.collectors.sentences import collect_sentences
from ldrl.collectors.snippets import DisturbedView, Snippets, SnippetSampler, cut_snippets

__all__ = [
    "BoundarySampler",
    "DisturbedView",
    "DriveSampler",
    "Expert",
    "OncePerFrame",
    "Outcome",
    "Segment",
    "SnippetSampler",
    "Snippets",
    "SteeringNoise",
    "collect_demonstrations",
    "collect_sentences",
    "cut_snippets",
    "evaluate",
    "expert_action",
    "find_misleading",
    "find_segments",
    "load_demonstrations",
]
