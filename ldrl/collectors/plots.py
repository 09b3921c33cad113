"""Pictures of an evaluation and of a training: tracks from above, loss curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from ldrl.collectors.evaluation import Outcome
from ldrl.collectors.report import replacing, summarise
from ldrl.subtasks import SubTask
from ldrl.towns import Town
from ldrl.towns.surface import CELL

__all__ = ["COLOURS", "plot_losses", "plot_tracks"]

COLOURS = {
    SubTask.LEFT: "#0072B2",
    SubTask.RIGHT: "#D55E00",
    SubTask.STRAIGHT: "#009E73",
    SubTask.LANEFOLLOW: "#808080",
    SubTask.FINISH: "#CC79A7",
}
"""Okabe and Ito's colours, which colour-blind eyes tell apart too; grey for the usual."""
ROAD, MARKING = "#E4E4E4", "#FFFFFF"
SPREAD = 1.2
"""Tracks are drawn up to this far beside where they were, so that they do not all cover each other, m."""
MOST_NAMED = 20
"""Failed episodes named in the picture; the report names all."""


def plot_tracks(outcomes: Sequence[Outcome], town: Town, path: str | Path) -> Figure:
    """Draw a town from above, and in it every track coloured by the agent's sub-task, into a PNG file.

    North is up, so the y axis points down. A dot marks a start. A failed episode is drawn bold and on top, with its
    id at the cross where it ended, over the path that it should have taken.

    Args:
        outcomes: of any towns; those of others are left out.
        town: the town to draw.
        path: the file, written whole or not at all; its folder must exist.

    Returns:
        The figure.

    Raises:
        OSError: the file cannot be written.
    """
    here = [outcome for outcome in outcomes if outcome.episode.town == town.name]
    failed = [outcome for outcome in here if not outcome.success]
    height, width = town.road_distance.shape[-2:]
    figure = Figure(figsize=(11, 1.2 + 10 * height / width), dpi=150, layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x, east (m)", ylabel="y, south (m)")
    axes.spines[["top", "right"]].set_visible(False)
    _draw_town(axes, town)
    _draw_succeeded(axes, [outcome for outcome in here if outcome.success])
    for number, outcome in enumerate(failed):
        _draw_failed(axes, outcome, named=number < MOST_NAMED)
    axes.set_title(_title(here, town.name), pad=10, parse_math=False)
    handles = [Line2D([], [], color=colour, lw=2.5, label=subtask.name.lower()) for subtask, colour in COLOURS.items()]
    handles.append(Line2D([], [], ls="", marker="o", ms=3, color="black", label="start"))
    if failed:
        handles.append(Line2D([], [], ls="", marker="x", ms=8, mew=2.5, color="black", label="end of a failed episode"))
        handles.append(Line2D([], [], ls=":", lw=1.5, color="black", label="path of a failed episode"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return figure


def _draw_town(axes: Axes, town: Town) -> None:
    distance = town.road_distance[0, 0].cpu().numpy()
    x0, y0 = town.raster_origin.tolist()
    x, y = x0 + CELL * np.arange(distance.shape[1]), y0 + CELL * np.arange(distance.shape[0])
    axes.contourf(x, y, distance, levels=[distance.min() - 1, 0], colors=[ROAD], zorder=0)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[-1], y[0])
    points, headings = town.points.cpu().numpy(), town.headings.cpu().numpy()
    bounds = [*town.lane_first.tolist(), len(points)]
    middles = []
    for index, manoeuvre, (a, b) in zip(town.lane_indices, town.lane_manoeuvre, pairwise(bounds), strict=True):
        if manoeuvre == SubTask.LANEFOLLOW:
            half_width = town.network.get_lane(index).width_at(0) / 2
            middles.append(points[a:b] + half_width * _left(headings[a:b]))
    axes.add_collection(LineCollection(middles, colors=MARKING, lw=0.8, zorder=1), autolim=False)


def _left(headings: np.ndarray) -> np.ndarray:
    """``[N, 2]`` unit vectors to the left of ``[N]`` headings, with y pointing south."""
    return np.stack((np.sin(headings), -np.cos(headings)), -1)


def _draw_succeeded(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    # Spread over the width of the lane in an order that puts neighbours apart (a golden-ratio sequence).
    tracks = [_beside(o.track.numpy(), SPREAD * (2 * (k * 0.618034 % 1) - 1)) for k, o in enumerate(outcomes)]
    for subtask in (SubTask.LANEFOLLOW, SubTask.FINISH, SubTask.STRAIGHT, SubTask.RIGHT, SubTask.LEFT):
        pieces = [piece for track, o in zip(tracks, outcomes, strict=True) for piece in _pieces(track, o, subtask)]
        style = {"lw": 0.6, "alpha": 0.5} if subtask == SubTask.LANEFOLLOW else {"lw": 1.1, "alpha": 0.75}
        axes.add_collection(LineCollection(pieces, colors=COLOURS[subtask], zorder=2, **style), autolim=False)
    starts = np.array([track[0] for track in tracks]).reshape(-1, 2)
    axes.scatter(starts[:, 0], starts[:, 1], s=3, c="black", lw=0, zorder=3)


def _draw_failed(axes: Axes, outcome: Outcome, *, named: bool) -> None:
    track = outcome.track.numpy()
    halo = [Stroke(linewidth=6, foreground="white"), Normal()]
    # A car that left the picture ends at its edge.
    end = np.clip(track[-1], *np.sort([axes.get_xlim(), axes.get_ylim()]).T)
    axes.plot(*np.array(outcome.episode.path).T, color="black", lw=1.8, ls=":", path_effects=halo, zorder=4)
    axes.plot(*track.T, color="black", lw=4.5, path_effects=halo, zorder=5)
    for subtask in SubTask:
        pieces = _pieces(track, outcome, subtask)
        axes.add_collection(LineCollection(pieces, colors=COLOURS[subtask], lw=3, zorder=6), autolim=False)
    axes.plot(*track[0], color="black", marker="o", ms=6, zorder=7)
    axes.plot(*end, color="black", marker="x", ms=10, mew=2.5, path_effects=halo, zorder=8)
    if named:
        name = _printable(outcome.episode.id)
        box = {"boxstyle": "round,pad=0.2", "fc": "white", "lw": 0.5, "alpha": 0.9}
        axes.annotate(name, end, (8, 8), textcoords="offset points", size=8, parse_math=False, bbox=box, zorder=9)


def _beside(track: np.ndarray, offset: float) -> np.ndarray:
    """``[T, 2]`` points shifted by ``offset`` metres to the left of where the track goes."""
    step = np.gradient(track, axis=0)
    # A standing car points where it last went.
    moving = np.hypot(*step.T) > 0.05
    step = step[np.maximum.accumulate(np.where(moving, np.arange(len(step)), moving.argmax()))]
    return track + offset * _left(np.arctan2(step[:, 1], step[:, 0]))


def _pieces(track: np.ndarray, outcome: Outcome, subtask: SubTask) -> list[np.ndarray]:
    """The stretches that were driven in a sub-task, each up to the first point of the next."""
    subtasks = outcome.subtasks.numpy()
    cuts = [0, *(np.flatnonzero(np.diff(subtasks)) + 1).tolist(), len(subtasks)]
    return [track[a : b + 1] for a, b in pairwise(cuts) if subtasks[a] == subtask]


def _printable(text: str) -> str:
    shown = "".join(c if c.isprintable() and c < "\u0250" else "?" for c in text[:32])
    return shown + "..." * (len(text) > 32)


def _title(outcomes: Sequence[Outcome], town: str) -> str:
    if not outcomes:
        return f"{_printable(town)}: no episodes"
    success, strict_success = (summarise(outcomes)[name] for name in ("success", "strict_success"))
    return f"{_printable(town)}, {len(outcomes)} episodes: success {success:.3f}, strict success {strict_success:.3f}"


def plot_losses(history: Mapping[str, Sequence[float]], path: str | Path) -> Figure:
    """Draw loss curves into a PNG file, a panel each: the values pale, their running mean over them.

    Losses that fall to less than a fifth have a logarithmic axis.

    Args:
        history: each loss at every update, such as the columns of a CSV log; NaN where there is none.
        path: the file, written whole or not at all; its folder must exist.

    Returns:
        The figure.

    Raises:
        ValueError: the history is empty.
        OSError: the file cannot be written.
    """
    if not history:
        raise ValueError("the history is empty, so there is no loss to draw; give the values of at least one")
    figure = Figure(figsize=(4 * len(history), 3.2), dpi=150, layout="constrained")
    for axes, (name, values) in zip(figure.subplots(1, len(history), squeeze=False)[0], history.items(), strict=True):
        loss = np.asarray(values, float)
        updates = np.flatnonzero(np.isfinite(loss)) + 1
        loss = loss[updates - 1]
        smooth = _running_mean(loss)
        axes.plot(updates, loss, color=COLOURS[SubTask.LEFT], lw=0.6, alpha=0.3)
        axes.plot(updates, smooth, color=COLOURS[SubTask.LEFT], lw=1.8)
        if len(loss) and loss.min() > 0 and smooth[-1] < smooth[0] / 5:
            axes.set_yscale("log")
        axes.set_title(name.removeprefix("loss_").replace("_", " "), parse_math=False)
        axes.set_xlabel("update")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    return figure


def _running_mean(values: np.ndarray) -> np.ndarray:
    """``[N]`` means over a window of a fortieth of the values, which is shorter at the ends."""
    window = np.ones(2 * (len(values) // 80) + 1)
    if not len(values):
        return values
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")
