"""The dash camera: what the car sees, drawn from its pose."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import Transform

from ldrl import keys
from ldrl.envs.appearance import WEATHERS, Look, appearance_number, looks
from ldrl.envs.painting import paint
from ldrl.envs.sight import HEIGHT, HORIZON, STEMS_IN_SIGHT, WIDTH, Mount, Sight
from ldrl.towns import Town
from ldrl.towns.ground import Material

__all__ = ["DashCamera", "shift"]

MOST_APPEARANCES = 1 << 60
CHANNELS = {"gs": 1, "rgb": 3}
"""Channels of the image in each modality."""
FRAMES_AT_ONCE = {"cpu": 128, "cuda": 2048}
"""Frames drawn together: on a processor so few that their rays stay in its cache, on a GPU as many as keep it busy."""


def shift(pose: Tensor, lateral: Tensor | float, yaw: Tensor | float) -> Tensor:
    """Move poses sideways and turn them.

    Args:
        pose: ``[*B, 3]``: x, y (m), heading (rad).
        lateral: ``[*B]`` or a number, to the right, m.
        yaw: ``[*B]`` or a number, to the right, rad.

    Returns:
        ``[*B, 3]``.

    Examples:
        >>> shift(torch.zeros(3), lateral=1.0, yaw=0.5)
        tensor([0.0000, 1.0000, 0.5000])
    """
    x, y, heading = pose.unbind(-1)
    return torch.stack((x - heading.sin() * lateral, y + heading.cos() * lateral, heading + yaw), -1)


def see_moving(transform: Transform, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
    """The step of a transform that makes images, of the cars that move; those that ``_step`` holds see black.

    Args:
        transform: what makes images, of any batch of cars.
        tensordict: batch size ``[B]``, before the step.
        next_tensordict: batch size ``[B]``, after it.
    """
    moving = tensordict.get("_step", None)
    if moving is None:
        return transform._call(next_tensordict)
    moving = moving.view(next_tensordict.batch_size)
    read = next_tensordict.select(keys.POSE, keys.TRAFFIC, keys.APPEARANCE, keys.IMAGE, strict=False)
    seen = transform._call(read[moving])[keys.IMAGE]
    image = seen.new_zeros((*moving.shape, *seen.shape[1:]))
    image[moving] = seen
    return next_tensordict.set(keys.IMAGE, image)


class DashCamera(Transform):
    """Draws the 88x200 image of a forward camera from ``("world", "pose")``, the whole batch at once.

    The same transform serves an env (draw now) and a replay buffer (draw when sampled). The camera stands 1.6 m ahead
    of the vehicle's origin and 1.7 m above a flat road, has no pitch, and sees 90 degrees across. Buildings, trees,
    posts and the other cars of ``("world", "traffic")``, if there are any, hide what is behind them. In a step of some
    cars only, as ``_step`` says, the others see black.

    Args:
        town: what there is to see.
        modality: ``"gs"``, a binary segmentation, one channel: 255 where the ray through the pixel's centre meets the
            drivable surface first; or ``"rgb"``.
        appearance: of rgb images. ``"clear"``, ``"overcast"``, ``"rain"``, ``"fog"``, ``"sunset"`` or ``"night"``: the
            town's own materials in that weather. A number: other materials and weather, the same for the same number.
            ``"episode"``: a new number at each reset, kept in ``("world", "appearance")`` and read from there in a
            replay buffer. ``"sample"``: a new number for each image.
        lateral: offset of the mount to the right, m.
        yaw: turn of the mount to the right, rad.
        seed: of the numbers drawn; parallel workers need one each, for ``env.set_seed`` does not reach it.

    Moved to a device, it moves the town's scenery, which all its cameras share: give it a town that is there already.

    Raises:
        ValueError: an unknown modality or appearance.

    Examples:
        >>> camera = DashCamera(Town.load("town1"))
        >>> camera.draw(torch.tensor([[200.0, 2.0, 3.14]])).shape
        torch.Size([1, 1, 88, 200])
        >>> DashCamera(Town.load("town2"), modality="rgb", appearance="sunset").draw(torch.zeros(5, 3)).shape
        torch.Size([5, 3, 88, 200])
    """

    _numbers: Tensor
    colours: Tensor
    sun: Tensor

    def __init__(
        self,
        town: Town,
        *,
        modality: Literal["gs", "rgb"] = "gs",
        appearance: str | int = "clear",
        lateral: float = 0.0,
        yaw: float = 0.0,
        seed: int = 0,
    ) -> None:
        if modality not in CHANNELS:
            raise ValueError(f"modality {modality!r} is unknown; use one of {', '.join(CHANNELS)}")
        super().__init__(in_keys=[keys.POSE], out_keys=[keys.IMAGE])
        self.scenery = town.scenery
        self.sight = Sight()
        self.modality = modality
        self.appearance = appearance
        self.lateral = lateral
        self.yaw = yaw
        self._generator = torch.Generator().manual_seed(seed)
        if isinstance(appearance, str):
            drawn = appearance in ("episode", "sample")
            number = 0 if drawn else appearance_number(self.scenery.seed, appearance)
        elif type(appearance) is int and 0 <= appearance < MOST_APPEARANCES:
            number = appearance
        else:
            choices = f"a number from 0 to 2**60 - 1, 'episode', 'sample' or one of {', '.join(WEATHERS)}"
            raise ValueError(f"appearance is {appearance!r}; use {choices}")
        for name, value in looks(torch.tensor([number]))._asdict().items():
            self.register_buffer(name, value, persistent=False)
        self.register_buffer("_numbers", torch.zeros(0, dtype=torch.long), persistent=False)

    def draw(self, pose: Tensor, traffic: Tensor | None = None, number: Tensor | None = None) -> Tensor:
        """Draw images.

        Args:
            pose: of the vehicle's origin, ``[*B, 3]`` float32: x, y (m), heading (rad).
            traffic: other cars, ``[*B, N, 4]`` float32: x, y (m), heading (rad), speed (m/s).
            number: appearances, ``[*B]`` int64; None draws or takes what the camera was made with.

        Returns:
            ``[*B, C, 88, 200]`` uint8; ``gs``: 0 or 255.
        """
        batch = pose.shape[:-1]
        pose = shift(pose, self.lateral, self.yaw).reshape(-1, 3)
        traffic = None if traffic is None or not traffic.shape[-2] else traffic.reshape(-1, *traffic.shape[-2:])
        look = self._look(len(pose), number) if self.modality == "rgb" else None
        images = pose.new_empty((len(pose), CHANNELS[self.modality], HEIGHT, WIDTH), dtype=torch.uint8)
        at_once = FRAMES_AT_ONCE["cpu" if pose.device.type == "cpu" else "cuda"]
        for first in range(0, len(pose), at_once):
            rows = slice(first, first + at_once)
            mount, others = Mount.on(pose[rows]), None if traffic is None else traffic[rows]
            if look is None:
                images[rows, 0, :HORIZON] = 0
                images[rows, 0, HORIZON:] = self._road(mount, others)
            else:
                paint(self.sight, self.scenery, mount, look.rows(rows), others, out=images[rows])
        return images.view(*batch, *images.shape[1:])

    def _look(self, count: int, number: Tensor | None) -> Look:
        """How things look in each image, or in all of them."""
        if number is None and self.appearance == "sample":
            number = self._draw_numbers(count)
        return Look(self.colours, self.sun) if number is None else looks(number.reshape(-1))

    def _draw_numbers(self, count: int) -> Tensor:
        return torch.randint(1 << 40, (count,), generator=self._generator).to(self.sun.device)

    def _road(self, mount: Mount, traffic: Tensor | None) -> Tensor:
        """Whether the rays below the horizon meet the road first: ``[N, 44, 200]`` uint8, 255 or 0."""
        ground, wall = self.sight.ground(self.scenery, mount)
        props = self.sight.props(self.scenery, mount, STEMS_IN_SIGHT)
        obstacles = self.sight.obstacles(self.scenery, props, wall)
        hidden = self.sight.within(obstacles.rows)
        if traffic is not None:
            hidden |= self.sight.covers(self.sight.cars(mount, traffic), obstacles).amin(1)
        road = (ground - (Material.STOP_LINE + 1)) >> 7  # the road's numbers wrap around to more than 127
        return road.neg_().bitwise_and_(hidden.bitwise_not_().to(torch.uint8))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        number = None
        if self.appearance == "episode":
            number = next_tensordict.get(keys.APPEARANCE, None)
            if number is None:
                number = self._episodes_numbers(next_tensordict)
        image = self.draw(next_tensordict[keys.POSE], next_tensordict.get(keys.TRAFFIC, None), number)
        return next_tensordict.set(keys.IMAGE, image)

    def _episodes_numbers(self, tensordict: TensorDictBase) -> Tensor:
        """The numbers drawn at the resets, written into the data."""
        if len(self._numbers) != tensordict.numel():
            raise ValueError(
                "appearance='episode' needs the env's reset or ('world', 'appearance') in the data; use 'sample'"
            )
        tensordict[keys.APPEARANCE] = self._numbers.view(*tensordict.batch_size, 1)
        return tensordict[keys.APPEARANCE]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.appearance == "episode":
            self._episodes_numbers(next_tensordict)
        return see_moving(self, tensordict, next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Draw the images of a batch from a replay buffer."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self.appearance == "episode":
            cars, reset = tensordict_reset.numel(), tensordict.get("_reset", None)
            drawn = self._draw_numbers(cars).to(tensordict_reset.device)
            if reset is not None and len(self._numbers) == cars:
                drawn = torch.where(reset.view(-1), drawn, self._numbers)
            self._numbers = drawn
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the image, and the appearance where it belongs to the episode."""
        batch, device = observation_spec.shape, observation_spec.device
        shape = (*batch, CHANNELS[self.modality], HEIGHT, WIDTH)
        observation_spec[keys.IMAGE] = Bounded(0, 255, shape, device, torch.uint8)
        if self.appearance == "episode":
            observation_spec[keys.APPEARANCE] = Unbounded((*batch, 1), device, torch.int64)
        return observation_spec
