"""What the paper measured (Roh et al. 2019), and what this project sets itself to reach."""

from __future__ import annotations

from typing import NamedTuple

from ldrl.modules import AgentConfig

__all__ = ["LEAST_IOU", "MOST_MINUTES", "SUCCESS", "TARGETS", "Success", "Target", "paper_success"]

Success = dict[str, dict[str, float]]
"""Success rates by town and type of keyword; the paper trains on Town 1 and tests on Town 2 too."""


def _success(**types: tuple[float, float]) -> Success:
    """From pairs of train and test."""
    return {town: {name: pair[k] for name, pair in types.items()} for k, town in enumerate(("town1", "town2"))}


SUCCESS: dict[str, Success] = {
    # Table 2
    "gs-hih": _success(single=(1.000, 1.000), double=(1.000, 0.986), ordinal=(1.000, 0.938), all=(1.000, 0.970)),
    "rgb-hih": _success(single=(1.000, 1.000), double=(0.809, 0.439), ordinal=(0.813, 0.333), all=(0.880, 0.613)),
    "ps-hih": _success(single=(0.982, 1.000), double=(0.976, 0.874), ordinal=(1.000, 0.938), all=(0.982, 0.926)),
    # Table 3
    "gs-single": _success(single=(0.721, 0.583), double=(0.033, 0.000), ordinal=(0.028, 0.000), all=(0.288, 0.197)),
    "gs-single-history": _success(
        single=(0.684, 0.667), double=(0.077, 0.000), ordinal=(0.142, 0.000), all=(0.311, 0.225)
    ),
    "gs-nmc": _success(single=(0.218, 0.208), double=(0.000, 0.000), ordinal=(0.000, 0.000), all=(0.081, 0.070)),
    "gs-h0": _success(single=(1.000, 1.000), double=(1.000, 1.000), ordinal=(0.969, 0.906), all=(0.996, 0.986)),
    "gs-hi": _success(single=(1.000, 1.000), double=(0.979, 0.982), ordinal=(1.000, 0.813), all=(0.990, 0.991)),
    "gs-hihg": _success(single=(0.984, 1.000), double=(0.976, 0.943), ordinal=(0.972, 0.886), all=(0.979, 0.954)),
    # Table A3
    "rgb-h0": _success(all=(0.858, 0.621)),
    "rgb-hi": _success(all=(0.867, 0.586)),
    "ps-h0": _success(all=(0.939, 0.923)),
    "ps-hi": _success(all=(0.973, 0.898)),
    # misleading instructions only
    "gs-h0-misleading": _success(single=(1.000, 1.000), double=(0.758, 0.652), all=(0.828, 0.742)),
    "gs-hi-misleading": _success(single=(1.000, 1.000), double=(1.000, 0.957), all=(1.000, 0.968)),
    "gs-hih-misleading": _success(single=(1.000, 1.000), double=(1.000, 0.928), all=(1.000, 0.946)),
}
"""By modality and model. For double of Hih in Town 2, Table 2 has 0.986 and Table 3 0.960."""


def paper_success(config: AgentConfig, *, misleading: bool = False) -> Success:
    """What the paper reports of an agent of the same model and modality; nothing of those that it does not have.

    Args:
        config: the agent's.
        misleading: on misleading instructions.
    """
    return SUCCESS.get(f"{config.modality}-{config.model}{'-misleading' if misleading else ''}", {})


class Target(NamedTuple):
    """A rate to reach, as the mean of three seeds.

    Attributes:
        cell: what is measured, a modality and a model, and the episodes if they are not the built-in ones.
        town: ``"town1"``, ``"town2"`` or ``"unseen"``.
        type: of keyword, or ``"all"``.
        measure: ``"success"``, ``"strict_success"`` or ``"kept"``, success as a share of that on clean sentences.
        least: the rate.
    """

    cell: str
    town: str
    type: str
    measure: str
    least: float


TARGETS = (
    *(
        Target(f"{modality}-hih", town, "all", "success", least)
        for modality, both in (("gs", (1.000, 0.995)), ("ps", (0.995, 0.985)), ("rgb", (0.995, 0.980)))
        for town, least in zip(("town1", "town2"), both, strict=True)
    ),
    *(
        Target(f"{modality}-hih", town, name, "success", least)
        for modality in ("gs", "ps", "rgb")
        for name in ("single", "double", "ordinal")
        for town, least in (("town1", 0.98), ("town2", 0.96))
    ),
    Target("gs-hih-misleading", "town1", "all", "success", 1.000),
    Target("gs-hih-misleading", "town2", "all", "success", 0.985),
    Target("gs-hih", "town1", "all", "strict_success", 0.98),
    Target("gs-hih", "town2", "all", "strict_success", 0.97),
    Target("gs-hih-paraphrase", "town2", "all", "kept", 0.98),
    Target("gs-hih-ambiguity", "town2", "all", "kept", 0.97),
    Target("gs-hih-noise", "town2", "all", "kept", 0.97),
    Target("gs-hih-rambling", "town2", "all", "kept", 0.97),
    Target("gs-hih-unseen", "unseen", "all", "success", 0.97),
)
"""What the full model should reach."""
LEAST_IOU = 0.95
"""Intersection over union of the road that the segmenter should reach."""
MOST_MINUTES = 120
"""In which the cells of the paper's tables should be made for a seed, on two CPU cores."""
