"""Sub-task labels from the route."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, TensorSpec
from torchrl.envs import Transform

from ldrl import keys
from ldrl.subtasks import SubTask
from ldrl.towns import Town

__all__ = ["APPROACH", "SubtaskLabels", "route_subtask"]

APPROACH = 6.0
"""A manoeuvre begins this far before its junction, m."""


def route_subtask(town: Town, route: Tensor, position: Tensor) -> Tensor:
    """The sub-task that a route asks for.

    A manoeuvre lasts from 6 m before its junction to the junction's exit; all between is lane following.

    Args:
        town: the town.
        route: ``[*B, 6]`` integer, route windows.
        position: ``[*B]`` float32, route positions, m.

    Returns:
        ``[*B]`` int64 :class:`SubTask`.
    """
    window, along = town.locate(route, position.unsqueeze(-1))
    lane = route.long().gather(-1, window)
    manoeuvres = town.lane_manoeuvre[route.long()]
    ahead = torch.arange(route.shape[-1], device=route.device) > window
    following = ((manoeuvres != SubTask.LANEFOLLOW) & ahead).int().argmax(-1, keepdim=True)
    here = manoeuvres.gather(-1, window)
    to_junction = town.lane_length[lane] - along + town.lane_to_junction[lane]
    coming = torch.where(to_junction <= APPROACH, manoeuvres.gather(-1, following), SubTask.LANEFOLLOW)
    return torch.where(here == SubTask.LANEFOLLOW, coming, here).squeeze(-1)


class SubtaskLabels(Transform):
    """Writes ``subtask``, and ``end_of_subtask`` where it differs from the sub-task of the step before.

    Args:
        town: the town that the routes are in.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from ldrl.envs import TownEnv
        >>> town = Town.load("town1")
        >>> env = TransformedEnv(TownEnv(town, num_cars=2), SubtaskLabels(town))
        >>> env.rollout(3, break_when_any_done=False)["subtask"].shape
        torch.Size([2, 3])
    """

    def __init__(self, town: Town) -> None:
        super().__init__(in_keys=[keys.ROUTE, keys.ROUTE_POSITION], out_keys=[keys.SUBTASK, keys.END_OF_SUBTASK])
        self.town = town

    def _label(self, tensordict: TensorDictBase) -> Tensor:
        return route_subtask(self.town, tensordict[keys.ROUTE], tensordict[keys.ROUTE_POSITION].squeeze(-1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        subtask = self._label(tensordict_reset)
        tensordict_reset[keys.SUBTASK] = subtask
        tensordict_reset[keys.END_OF_SUBTASK] = torch.zeros_like(subtask, dtype=torch.bool)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        subtask = self._label(next_tensordict)
        next_tensordict[keys.SUBTASK] = subtask
        next_tensordict[keys.END_OF_SUBTASK] = subtask != tensordict[keys.SUBTASK]
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the labels."""
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[keys.SUBTASK] = Categorical(len(SubTask), shape, device)
        observation_spec[keys.END_OF_SUBTASK] = Binary(shape=shape, device=device, dtype=torch.bool)
        return observation_spec
