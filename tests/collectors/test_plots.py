import warnings

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from ldrl.collectors.evaluation import Outcome
from ldrl.collectors.plots import COLOURS, ROAD, plot_losses, plot_tracks
from ldrl.envs import Episode
from ldrl.subtasks import SubTask
from ldrl.towns.surface import CELL, sample

LENGTH = 40.0
STARTS = {SubTask.LANEFOLLOW: (20.0, 40.0), SubTask.LEFT: (20.0, 160.0), SubTask.FINISH: (220.0, 100.0)}
"""Tracks of one sub-task each, east from here, most of them off the road, where nothing else is drawn."""


def outcome(xy, subtasks, name="x", town="town1", *, success=True):
    path = ((300.0, 250.0), (330.0, 250.0))
    return Outcome(
        episode=Episode(name, town, "left", "turn left", (0.0, 0.0, 0.0), path),
        success=success,
        strict_success=success,
        collision=False,
        off_road=False,
        wrong_lane=False,
        finished=success,
        stuck=False,
        finish_distance=None,
        largest_gap=0.0,
        seconds=1.0,
        track=torch.as_tensor(xy, dtype=torch.float32),
        subtasks=torch.as_tensor(subtasks, dtype=torch.int64),
    )


def eastwards(start, subtask, **kwargs):
    x = torch.arange(0, LENGTH + 1)
    track = torch.stack((start[0] + x, torch.full_like(x, start[1])), -1)
    return outcome(track, torch.full((len(track),), int(subtask)), **kwargs)


def patch(figure, path, x, y, radius=2.0):
    """``[N, 3]`` colours of the file within ``radius`` metres of a point."""
    image = imread(path)[..., :3]
    to_pixels = figure.axes[0].transData.transform
    (left, top), (right, bottom) = to_pixels([(x - radius, y - radius), (x + radius, y + radius)])
    rows = slice(round(image.shape[0] - top), round(image.shape[0] - bottom) + 1)
    return image[rows, round(left) : round(right) + 1].reshape(-1, 3)


def share(colours, colour, tolerance=0.02):
    return (np.abs(colours - to_rgb(colour)).max(-1) < tolerance).mean()


def test_the_map_is_where_the_town_is(town, tmp_path):
    path = tmp_path / "tracks.png"
    figure = plot_tracks([], town, path)
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    image = imread(path)[..., :3]
    # Cells well on the road and well off it, away from the white line in the middle.
    cells = torch.cartesian_prod(*(torch.arange(16, n - 16, 5) for n in town.road_distance.shape[-2:])).flip(-1)
    points = town.raster_origin + CELL * cells
    distance = sample(town.road_distance, town.raster_origin, points)[:, 0]
    column, up = figure.axes[0].transData.transform(points.numpy()).round().astype(int).T
    colours = image[image.shape[0] - 1 - up, column]
    lane, ground = ((distance > -2.5) & (distance < -1)).numpy(), (distance > 1).numpy()
    assert lane.sum() > 200
    assert share(colours[lane], ROAD) > 0.99
    assert share(colours[ground], "white") == 1


def test_north_is_up_and_metres_are_equal(town1, tmp_path):
    figure = plot_tracks([], town1, tmp_path / "tracks.png")
    (x0, y0), (x1, y1) = figure.axes[0].transData.transform([(0, 0), (100, 100)])
    assert x1 > x0
    assert y1 < y0
    assert x1 - x0 == pytest.approx(y0 - y1, rel=1e-3)


def test_tracks_have_the_colour_of_their_subtask(town1, tmp_path):
    path = tmp_path / "tracks.png"
    figure = plot_tracks([eastwards(start, subtask) for subtask, start in STARTS.items()], town1, path)
    for subtask, (x, y) in STARTS.items():
        colours = patch(figure, path, x + LENGTH / 2, y)
        darkest = colours[colours.sum(-1).argmin()]
        # A pale line on white lies between white and its own colour.
        colour = np.array(to_rgb(COLOURS[subtask]))
        depth = (1 - darkest).max() / (1 - colour).max()
        assert 0.3 < depth <= 1.01, subtask
        np.testing.assert_allclose(1 - darkest, depth * (1 - colour), atol=0.03)
        assert share(patch(figure, path, x + LENGTH / 2, y + 10), "white") == 1


def test_a_subtask_lasts_until_the_next(town1, tmp_path):
    x = torch.arange(0, LENGTH + 1)
    track = torch.stack((20 + x, torch.full_like(x, 40.0)), -1)
    subtasks = torch.where(x < 20, int(SubTask.RIGHT), int(SubTask.STRAIGHT))
    path = tmp_path / "tracks.png"
    figure = plot_tracks([outcome(track, subtasks, success=False)], town1, path)
    assert share(patch(figure, path, 34, 40), COLOURS[SubTask.RIGHT]) > 0.1
    assert share(patch(figure, path, 34, 40), COLOURS[SubTask.STRAIGHT]) == 0
    assert share(patch(figure, path, 46, 40), COLOURS[SubTask.STRAIGHT]) > 0.1
    assert share(patch(figure, path, 46, 40), COLOURS[SubTask.RIGHT]) == 0


def test_failures_are_bold_crossed_and_named(town1, tmp_path):
    good, bad = eastwards((20.0, 40.0), SubTask.LEFT), eastwards((20.0, 160.0), SubTask.LEFT, name="b", success=False)
    path = tmp_path / "tracks.png"
    figure = plot_tracks([bad, good], town1, path)
    assert share(patch(figure, path, 40, 40), COLOURS[SubTask.LEFT]) < 0.1
    assert share(patch(figure, path, 40, 160), COLOURS[SubTask.LEFT]) > 0.2
    assert share(patch(figure, path, 60, 160), "black") > 0.2  # the cross
    assert share(patch(figure, path, 60, 40), "black") == 0
    assert share(patch(figure, path, 315, 250, radius=8), "black") > 0.01  # the path that it should have taken
    assert [text.get_text() for text in figure.axes[0].texts] == ["b"]
    assert "2 episodes: success 0.500, strict success 0.500" in figure.axes[0].get_title()


def test_a_standing_car_leaves_no_hook(town1, tmp_path):
    # North, then standing: an offset to the side that the last heading does not tell would show to the east or west.
    y = torch.cat((torch.arange(200.0, 160.0, -1), torch.full((50,), 160.0)))
    track = torch.stack((torch.full_like(y, 40.0), y), -1)
    figure = plot_tracks([outcome(track, torch.full((len(y),), int(SubTask.FINISH)))], town1, tmp_path / "tracks.png")
    drawn = np.concatenate([line for lines in figure.axes[0].collections[2:-1] for line in lines.get_segments()])
    assert len(drawn) == len(track)
    assert np.ptp(drawn[:, 0]) < 1e-3


def test_other_towns_are_left_out(town2, tmp_path):
    elsewhere = eastwards((20.0, 160.0), SubTask.LEFT, success=False)
    empty, other = tmp_path / "empty.png", tmp_path / "other.png"
    assert plot_tracks([], town2, empty).axes[0].get_title() == "town2: no episodes"
    plot_tracks([elsewhere], town2, other)
    assert other.read_bytes() == empty.read_bytes()


@pytest.mark.parametrize("name", [r"$\frac$", "a\nb", "日本🚗", "\ud800", "", "i" * 5000])
def test_odd_ids_are_drawn_without_a_warning(town2, tmp_path, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = plot_tracks(
            [eastwards((20.0, 160.0), SubTask.LEFT, name=name, town="town2", success=False)], town2, tmp_path / "x.png"
        )
    assert len(figure.axes[0].texts[0].get_text()) <= 35


def test_a_car_beyond_the_map_ends_at_its_edge(town2, tmp_path):
    lost = eastwards((1000.0, -500.0), SubTask.LEFT, town="town2", success=False)
    axes = plot_tracks([lost], town2, tmp_path / "x.png").axes[0]
    assert axes.texts[0].xy == pytest.approx((axes.get_xlim()[1], axes.get_ylim()[1]))


@pytest.mark.parametrize(
    "plot", [lambda town, path: plot_tracks([], town, path), lambda _, path: plot_losses({"loss": [1]}, path)]
)
def test_failed_rendering_leaves_the_old_file(town2, tmp_path, monkeypatch, plot):
    def render(self, file, **kwargs):
        file.write_bytes(b"half a picture")
        raise MemoryError

    monkeypatch.setattr(Figure, "savefig", render)
    path = tmp_path / "x.png"
    path.write_text("old")
    with pytest.raises(MemoryError):
        plot(town2, path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_path_is_an_error_that_names_it(town2, tmp_path):
    with pytest.raises(OSError, match=r"cannot write .*missing/x\.png"):
        plot_tracks([], town2, tmp_path / "missing" / "x.png")


def test_losses_have_a_panel_each(tmp_path):
    path = tmp_path / "losses.png"
    values = np.exp(-np.arange(400) / 50) * np.random.default_rng(0).uniform(0.5, 1.5, 400)
    history = {"loss_control": values.tolist(), "loss_end_of_subtask": [0.5, float("nan"), 0.4], "accuracy": []}
    figure = plot_losses(history, path)
    assert imread(path).ndim == 3
    control, end, empty = figure.axes
    assert [axes.get_title() for axes in figure.axes] == ["control", "end of subtask", "accuracy"]
    raw, smooth = (line.get_xydata() for line in control.lines)
    np.testing.assert_allclose(raw, np.stack((np.arange(1, 401), values), -1))
    assert smooth[200, 1] == pytest.approx(values[195:206].mean())  # a fortieth: 11 of 400
    assert np.abs(np.diff(smooth[:, 1])).sum() < np.abs(np.diff(values)).sum() / 3
    assert (control.get_yscale(), end.get_yscale()) == ("log", "linear")
    assert end.lines[0].get_xdata().tolist() == [1, 3]
    assert len(empty.lines[0].get_xdata()) == 0


def test_a_constant_loss_stays_constant(tmp_path):
    figure = plot_losses({"loss": [2.0] * 300}, tmp_path / "losses.png")
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), 2.0)


def test_no_history_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="history is empty"):
        plot_losses({}, tmp_path / "losses.png")
    assert not list(tmp_path.iterdir())
