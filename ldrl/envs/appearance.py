"""Appearances of a town: colours, time of day and weather, drawn from a number."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ldrl.towns.ground import Material
from ldrl.towns.noise import hash_uniform
from ldrl.towns.scenery import STYLES

__all__ = ["BANDS", "CODES", "WEATHERS", "Code", "Look", "appearance_number", "looks"]

WEATHERS = ("clear", "overcast", "rain", "fog", "sunset", "night")
"""Weather and time of day."""
CODES = 128
"""Room for colour codes."""
BANDS = 8
"""Bands of depth, in which haze is the same."""
SHADES = 3
"""Facades: averted from the sun, beside it, towards it."""
PARTS = 3
"""Facades: wall, window, ground floor."""
CAR_COLOURS = 5
CAR_PARTS = 4
"""Cars: roof, windows, body, tyres."""
SKY_BANDS = 11


class Code:
    """Colour codes: those of the ground are :class:`~ldrl.towns.ground.Material`."""

    FACADE = Material.YARD + 3  # by style, shade and part
    SKY = FACADE + (STYLES + 1) * SHADES * PARTS  # from the horizon up
    TRUNK = SKY + SKY_BANDS
    POST = TRUNK + 1
    FOLIAGE = POST + 1  # lower, upper
    LAMP = FOLIAGE + 2
    CAR = LAMP + 1  # by colour and part


class Look(NamedTuple):
    """How things look.

    Attributes:
        colours: ``[*B, 1024]`` int32, ``blue << 16 | green << 8 | red`` of each code (7 bits) in each band of depth.
        sun: ``[*B, 2]`` float32, unit vector towards the sun on the map.
    """

    colours: Tensor
    sun: Tensor

    def rows(self, rows: slice) -> Look:
        """The looks of some rows, or the one look of all."""
        return self if len(self.sun) == 1 else Look(self.colours[rows], self.sun[rows])


# Sky above, sky at the horizon (also the haze), light on the ground, sunlight on facades (0 to 1), haze per metre.
_WEATHERS = torch.tensor(
    [
        [0.28, 0.50, 0.85, 0.72, 0.82, 0.93, 1.05, 1.02, 0.95, 1.0, 0.004],  # clear
        [0.62, 0.65, 0.69, 0.74, 0.76, 0.78, 0.85, 0.86, 0.88, 0.2, 0.006],  # overcast
        [0.40, 0.43, 0.47, 0.55, 0.58, 0.61, 0.58, 0.60, 0.64, 0.1, 0.012],  # rain
        [0.70, 0.72, 0.74, 0.76, 0.77, 0.78, 0.80, 0.81, 0.82, 0.1, 0.030],  # fog
        [0.35, 0.38, 0.62, 0.98, 0.66, 0.42, 1.00, 0.78, 0.58, 0.9, 0.007],  # sunset
        [0.03, 0.04, 0.10, 0.10, 0.11, 0.17, 0.28, 0.30, 0.40, 0.2, 0.008],  # night
    ]
)
_FACADES = torch.tensor(
    [
        [0.56, 0.27, 0.20],  # brick
        [0.78, 0.70, 0.55],  # sandstone
        [0.90, 0.88, 0.83],  # plaster
        [0.62, 0.62, 0.60],  # concrete
        [0.80, 0.62, 0.45],  # terracotta
        [0.45, 0.52, 0.60],  # slate blue
        [0.86, 0.78, 0.50],  # ochre
        [0.40, 0.36, 0.33],  # dark stone
    ]
)
_CARS = torch.tensor([[0.75, 0.1, 0.1], [0.15, 0.25, 0.6], [0.85, 0.85, 0.87], [0.12, 0.12, 0.13], [0.55, 0.56, 0.58]])


def appearance_number(scenery: int, weather: str) -> int:
    """The number of the appearance with given materials under given weather.

    Args:
        scenery: at least 0; what the materials' colours are drawn from.
        weather: one of ``WEATHERS``.

    Raises:
        ValueError: there is no such weather.
    """
    if weather not in WEATHERS:
        raise ValueError(f"weather {weather!r} is unknown; use one of {', '.join(WEATHERS)}")
    return scenery * len(WEATHERS) + WEATHERS.index(weather)


def looks(number: Tensor) -> Look:
    """How the appearances with given numbers look.

    Args:
        number: ``[B]`` int64, at least 0, see :func:`appearance_number`.

    Examples:
        >>> looks(torch.tensor([0, 1])).colours.shape
        torch.Size([2, 1024])
    """
    device = number.device
    sky, horizon, light, sunlight, haze = _WEATHERS.to(device)[number % len(WEATHERS)].split([3, 3, 3, 1, 1], -1)
    drawn = _Draws(number // len(WEATHERS))
    sunlit = 1 - sunlight * (1 - torch.tensor([0.55, 0.8, 1.0], device=device))
    wet = (number % len(WEATHERS) == WEATHERS.index("rain")).view(-1, 1, 1)
    night = (number % len(WEATHERS) == WEATHERS.index("night")).view(-1, 1, 1)
    colours = torch.cat(
        (
            _ground(drawn, wet) * light.unsqueeze(1),
            _facades(drawn, sunlit, night, light),
            torch.lerp(horizon.unsqueeze(1), sky.unsqueeze(1), torch.linspace(0, 1, SKY_BANDS, device=device)[:, None]),
            _things(drawn, light, night),
        ),
        1,
    )
    colours = torch.nn.functional.pad(colours, (0, 0, 0, CODES - colours.shape[1]))
    veil = 1 - torch.exp(-haze * band_depths(device))
    hazed = torch.lerp(colours.unsqueeze(1), horizon[:, None, None], veil[:, :, None, None])
    hazed[:, :, Code.SKY : Code.TRUNK] = colours[:, None, Code.SKY : Code.TRUNK]
    red, green, blue = (hazed.clamp(0, 1) * 255).round().int().flatten(1, 2).unbind(-1)
    angle = 2 * torch.pi * drawn()
    return Look(blue << 16 | green << 8 | red, torch.stack((angle.cos(), angle.sin()), -1))


def band_depths(device: torch.device | str = "cpu") -> Tensor:
    """Where the haze of each band is taken, ``[8]``, m: 4 m and 1.6 times as far each time."""
    return 4 * 1.6 ** torch.arange(BANDS, device=device)


def band_of(depth: Tensor) -> Tensor:
    """The band of depths, in the same shape, int16."""
    return (torch.log2(depth / 4) / 0.678 + 0.5).clamp(0, BANDS - 1).to(torch.int16)


class _Draws:
    """Numbers in [0, 1), ``[B]``, new ones at each call, that depend on the appearance only."""

    def __init__(self, scenery: Tensor) -> None:
        self.scenery, self.calls = scenery, 0

    def __call__(self) -> Tensor:
        self.calls += 1
        return hash_uniform(self.scenery, self.calls)

    def between(self, low: list[float], high: list[float]) -> Tensor:
        """Colours between two, ``[B, 1, 3]``."""
        ends = torch.tensor([low, high], device=self.scenery.device)
        tint = torch.stack([self() for _ in range(3)], -1) * 0.2 - 0.1
        return torch.lerp(ends[0], ends[1], (self().unsqueeze(-1) + tint).clamp(0, 1)).unsqueeze(1)


def _shades(colour: Tensor, count: int, spread: float) -> Tensor:
    """A colour ``[B, 1, 3]`` from dark to bright."""
    return colour * torch.linspace(1 - spread, 1 + spread, count, device=colour.device).view(1, -1, 1)


def _ground(drawn: _Draws, wet: Tensor) -> Tensor:
    """Colours of the ground's materials, ``[B, 24, 3]``."""
    asphalt = drawn.between([0.20, 0.20, 0.21], [0.44, 0.43, 0.42])
    white = drawn.between([0.72, 0.72, 0.70], [0.95, 0.95, 0.93])
    yellow = drawn.between([0.75, 0.55, 0.10], [0.92, 0.75, 0.25])
    centre = torch.where((drawn() < 0.5).view(-1, 1, 1), yellow, white)
    gap = torch.where((drawn() < 0.4).view(-1, 1, 1), centre, asphalt)
    edge = torch.where((drawn() < 0.7).view(-1, 1, 1), white, asphalt)
    pavement = drawn.between([0.46, 0.44, 0.42], [0.72, 0.68, 0.62])
    lawn = drawn.between([0.20, 0.38, 0.12], [0.56, 0.54, 0.26])
    yard = drawn.between([0.40, 0.34, 0.27], [0.66, 0.60, 0.52])
    road = [_shades(asphalt, 6, 0.12), _shades(asphalt * 0.72, 2, 0.05), edge, centre, gap, white, white]
    road = [torch.where(wet, colour * 0.7, colour) for colour in road]
    aside = [pavement * 1.15, _shades(pavement, 3, 0.05), _shades(lawn, 4, 0.1), _shades(yard, 3, 0.06)]
    return torch.cat(road + aside, 1)


def _facades(drawn: _Draws, sunlit: Tensor, night: Tensor, light: Tensor) -> Tensor:
    """Colours of the facades and of the hedge, ``[B, 63, 3]``."""
    walls = []
    for _ in range(STYLES):
        kind = (drawn() * len(_FACADES)).long()
        wall = _FACADES.to(kind.device)[kind].unsqueeze(1) * drawn.between([0.8] * 3, [1.1] * 3)
        window = drawn.between([0.10, 0.13, 0.17], [0.30, 0.36, 0.42])
        lit = torch.where((drawn() < 0.5).view(-1, 1, 1), drawn.between([0.9, 0.7, 0.35], [1.0, 0.9, 0.6]), window)
        walls.append(torch.cat((wall, torch.where(night, lit / light.unsqueeze(1), window), wall * 0.72), 1))
    hedge = drawn.between([0.14, 0.27, 0.10], [0.34, 0.38, 0.16])
    walls.append(torch.cat((hedge, hedge * 0.85, hedge * 0.8), 1))
    styles = torch.stack(walls, 1).unsqueeze(2)
    return (styles * sunlit.view(-1, 1, SHADES, 1, 1)).flatten(1, 3) * light.unsqueeze(1)


def _things(drawn: _Draws, light: Tensor, night: Tensor) -> Tensor:
    """Colours of trunks, posts, foliage, lamps and cars, ``[B, 25, 3]``."""
    trunk = drawn.between([0.22, 0.16, 0.11], [0.40, 0.32, 0.24])
    post = drawn.between([0.25, 0.27, 0.28], [0.55, 0.56, 0.56])
    leaves = drawn.between([0.13, 0.32, 0.10], [0.52, 0.42, 0.14])
    lamp = torch.where(night, 3.0, 0.8).expand(-1, 1, 3)
    body = _CARS.to(light.device).expand(len(light), -1, 3)
    part = torch.stack((body * 1.1, 0.15 + 0 * body, body * 0.85, 0.06 + 0 * body), 2).flatten(1, 2)
    return torch.cat((trunk, post, leaves * 0.8, leaves * 1.15, lamp, part), 1) * light.unsqueeze(1)
