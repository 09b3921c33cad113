"""Looks: as many colours as codes, the same for the same number, bytes in the right places, haze with depth."""

import pytest
import torch

from ldrl.envs.appearance import BANDS, CODES, WEATHERS, Code, appearance_number, band_depths, band_of, looks
from ldrl.towns.ground import Material


def channels(look):
    """``[B, bands, codes, 3]``."""
    colours = look.colours.view(-1, BANDS, CODES)
    return torch.stack((colours & 255, colours >> 8 & 255, colours >> 16), -1)


def test_a_row_is_its_number_alone():
    numbers = torch.tensor([0, 77, 5, 123456789012])
    look = looks(numbers)
    assert look.colours.shape == (4, BANDS * CODES)
    torch.testing.assert_close(look.sun.norm(dim=-1), torch.ones(4))
    for k in range(4):
        one = looks(numbers[k : k + 1])
        assert torch.equal(one.colours[0], look.colours[k])
        assert torch.equal(look.rows(slice(k, k + 1)).sun, one.sun)
    assert one.rows(slice(3, 9)) is one  # one look for all


def test_materials_are_told_apart():
    near = channels(looks(torch.arange(60)))[:, 0].float()
    for code in (Material.KERB, Material.SIDEWALK, Material.GRASS, Material.YARD):
        assert (near[:, code] - near[:, Material.ASPHALT]).abs().amax(-1).median() > 25
    white = near[WEATHERS.index("clear") :: len(WEATHERS), Material.STOP_LINE]
    assert (white > near[WEATHERS.index("clear") :: len(WEATHERS), Material.ASPHALT] + 40).all()
    assert near.flatten(1).unique(dim=0).shape[0] == 60


def test_rain_darkens_the_road_and_the_sun_one_side_of_a_house():
    numbers = torch.tensor([appearance_number(10, weather) for weather in ("overcast", "rain")])
    overcast, rain = channels(looks(numbers))[:, 0].float()
    share = rain / overcast.clamp(min=1)
    assert (share[Material.ASPHALT] < 0.85 * share[Material.SIDEWALK]).all()
    walls = channels(looks(torch.tensor([60])))[0, 0, Code.FACADE : Code.SKY].float().view(-1, 3, 3, 3)
    assert (walls[:, 0] < walls[:, 1]).all()
    assert (walls[:, 1] < walls[:, 2]).all()


def test_haze_grows_with_depth_towards_the_horizon():
    look = channels(looks(torch.tensor([WEATHERS.index("fog")])))[0].float()
    horizon = look[0, Code.SKY]
    away = (look[:, Material.PATCH] - horizon).abs().sum(-1)
    assert (away.diff() < 0).all()
    assert away[-1] < 0.2 * away[0]
    assert torch.equal(look[0, Code.SKY : Code.TRUNK], look[-1, Code.SKY : Code.TRUNK])


def test_bands_hold_their_depths():
    assert band_of(band_depths()).tolist() == list(range(BANDS))
    assert band_of(torch.tensor([0.1, 1e4, torch.inf])).tolist() == [0, BANDS - 1, BANDS - 1]


def test_codes_fit():
    assert Material.YARD < Code.FACADE < Code.SKY < Code.TRUNK < Code.CAR
    assert looks(torch.tensor([3])).colours.view(BANDS, CODES)[0, Code.LAMP] > 0
    assert Code.CAR + 20 <= CODES


def test_numbers():
    assert [appearance_number(10, weather) for weather in WEATHERS] == list(range(60, 66))
    with pytest.raises(ValueError, match="weather 'hail' is unknown; use one of clear, overcast"):
        appearance_number(0, "hail")
